"""Composites: a device with known truth on real, device-free X-ray backgrounds of a calibrated biplane system.

The folder holds `background_plane_a.png`, `background_plane_b.png` (8 bit grey, nearly free of noise) and
`calibration.json`: for `plane_a` and `plane_b` K (`K_corrected` where there is one), R and t of x = K (R X + t),
X in m.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..cli import ToolError
from ..data import Frame, View
from ..geometry.cameras import GeometryError, isocenter, make_view
from ..imaging.field import field_of_view
from ..sim import placement, xray
from ..sim.scenes import FRAME_ID, Scene

RADIUS = 0.00045            # m: a guidewire
LENGTHS = (0.06, 0.13)      # m
CONTRASTS = (0.25, 0.5)     # of the wire where the beam crosses it at a right angle
BLUR_PX = 0.8
NOISE = (1.5, 3.0)          # grey levels, sigma: from that of a good clinical system to twice as much
MASK_FRAMES = 8             # device-free frames averaged into a mask


@dataclass(frozen=True)
class Backgrounds:
    """What a biplane system sees without a device, and from where; the reference frame's origin is its isocentre."""

    images: tuple[np.ndarray, np.ndarray]   # (H, W) float32 grey levels
    views: tuple[View, View]
    fields: tuple[placement.Field, placement.Field]


@functools.lru_cache(maxsize=1)
def load(folder: Path) -> Backgrounds:
    """The backgrounds of a folder; raises ToolError that names the file which is missing or makes no sense."""
    calibration = folder / 'calibration.json'
    images = tuple(_image(folder / f'background_plane_{plane}.png') for plane in 'ab')
    try:
        planes = json.loads(calibration.read_text())
        views = tuple(_view(plane, planes[f'plane_{plane}'], image.shape) for plane, image in zip('ab', images))
    except (ValueError, KeyError, TypeError, GeometryError) as error:
        raise ToolError(f'{calibration}: not a calibration of planes a and b ({error!r})') from error
    to_isocentre = np.block([[np.eye(3), isocenter(views)[:, None]], [np.zeros(3), 1.0]])
    views = tuple(make_view(v.name, v.P @ to_isocentre, v.width, v.height) for v in views)
    fields = tuple(placement.lit_field(v, field_of_view(image) / 255) for v, image in zip(views, images))
    return Backgrounds(images, views, fields)


def composite(seed: int, folder: Path, device: bool = True,
              masked: bool = False) -> tuple[Scene, tuple[np.ndarray, np.ndarray] | None]:
    """A wire on the backgrounds of `folder` (every second one comes in through the border), and with `masked` the
    (H, W) float32 mask of each plane.

    The image is background * exp(-mu * path length) + white noise. `device` False leaves the wire out; its truth then
    says where it would be.
    """
    real = load(folder)
    shape, shaft = placement.place(np.random.default_rng([seed, 0]), real.fields, 'spline', LENGTHS,
                                   entering=bool(seed % 2))
    whole = placement.with_shaft(shape.backbone(), shaft)
    rng = np.random.default_rng([seed, 1])
    exposure = xray.Exposure(contrast=rng.uniform(*CONTRASTS), blur_px=BLUR_PX)
    noise = rng.uniform(*NOISE)
    shares = [xray.blurred(xray.transmission(whole, RADIUS, v, exposure), exposure) if device else 1.0
              for v in real.views]
    images = tuple(_noisy(image * share, noise, rng) for image, share in zip(real.images, shares))
    masks = None
    if masked:
        masks = tuple(np.mean([_noisy(image, noise, rng) for _ in range(MASK_FRAMES)], axis=0, dtype=np.float32)
                      for image in real.images)
    truth = placement.seen_in_both(whole, real.fields)
    return Scene(Frame(0, FRAME_ID, images, real.views), truth, RADIUS, truth[0], 'composite', seed), masks


def _noisy(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint8: noise only where X-rays came, as the unlit surround of a real image is black."""
    noise = np.float32(sigma) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.rint(np.clip(image + noise * (image > 2), 0, 255)).astype(np.uint8)


def _image(file: Path) -> np.ndarray:
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) if file.is_file() else None
    if image is None:
        raise ToolError(f'{file}: no such image')
    return image.astype(np.float32)


def _view(plane: str, calibration: dict, size: tuple[int, int]) -> View:
    K = np.array(calibration.get('K_corrected', calibration['K']), float)
    return make_view(plane, K @ np.c_[np.array(calibration['R'], float), np.array(calibration['t'], float)],
                     size[1], size[0])
