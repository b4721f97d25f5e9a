"""Scenes with known truth that were made elsewhere: a folder of folders, each with `plane_a.png`, `plane_b.png` (8 or
16 bit grey) and `scene.json`.

`scene.json` holds P_a and P_b (3x4, reference frame in m to px), radius_m, backbone_m (N x 3, base to tip, the part
that stands in both fields; empty where there is no device), device (whether both images show one) and family (what kind
of scene it is).
"""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import cv2
import numpy as np

from ..cli import ToolError
from ..data import Frame
from ..geometry.cameras import GeometryError, make_view
from ..sim.scenes import FRAME_ID, Scene
from .case import Case, Family

TEXT = 'scenes from elsewhere, by name of their folders'
IMAGES, ABOUT = ('plane_a.png', 'plane_b.png'), 'scene.json'


@functools.lru_cache(maxsize=1)
def open_family(folder: Path) -> Family:
    """The scenes in the folders of `folder`: seed 0 is the first by name. Raises ToolError that names the folder or
    file that is missing."""
    if not folder.is_dir():
        raise ToolError(f'{folder}: there is no such folder')
    scenes = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith('.'))
    if not scenes:
        raise ToolError(f'{folder}: no folders of scenes in it')
    for file in (scene / name for scene in scenes for name in (ABOUT, *IMAGES)):
        if not file.is_file():
            raise ToolError(f'{file}: there is no such file')
    return Family(TEXT, lambda seed: open_case(scenes[seed], seed), count=len(scenes))


def open_case(folder: Path, seed: int = 0) -> Case:
    """The scene in `folder`. Without a backbone its truth is (0, 3) and its base_position (0,): unknown. Raises
    ToolError that names what makes no sense."""
    file = folder / ABOUT
    images = tuple(_image(folder / name) for name in IMAGES)
    try:
        about = json.loads(file.read_bytes())
        truth, device = _backbone(about), _flag(about, 'device')
        views = tuple(make_view(plane, _numbers(about, f'P_{plane}'), image.shape[1], image.shape[0])
                      for plane, image in zip('ab', images))
        radius, kind = _numbers(about, 'radius_m'), str(about['family'])
        if radius.shape or not 0 < radius < 1:
            raise ValueError(f'radius_m is {about["radius_m"]}')
        if device and len(truth) < 2:
            raise ValueError('backbone_m has less than two points, but device is true')
    except KeyError as error:
        raise ToolError(f'{file}: {error.args[0]} is missing') from error
    except (ValueError, TypeError, GeometryError) as error:     # ValueError: json's too
        raise ToolError(f'{file}: {error}') from error
    scene = Scene(Frame(0, FRAME_ID, images, views), truth, float(radius), truth[0] if len(truth) else np.empty(0),
                  kind, seed)
    return Case(scene, note=folder.name, kind=kind, device=device)


def _image(file: Path) -> np.ndarray:
    """(H, W) uint8 or uint16."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if file.is_file() else None
    if image is None:
        raise ToolError(f'{file}: no such image')
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ToolError(f'{file}: not grey, of 8 or 16 bits')
    return image


def _numbers(about: dict, name: str) -> np.ndarray:
    try:
        numbers = np.array(about[name], float)
    except (ValueError, TypeError):
        numbers = np.array(math.nan)
    if not np.isfinite(numbers).all():
        raise ValueError(f'{name} is not made of finite numbers')
    return numbers


def _backbone(about: dict) -> np.ndarray:
    """(N, 3) m; N may be 0."""
    points = _numbers(about, 'backbone_m')
    if points.size and (points.ndim != 2 or points.shape[1] != 3):
        raise ValueError(f'backbone_m must be N x 3, got {" x ".join(map(str, points.shape)) or "a number"}')
    return points.reshape(-1, 3)


def _flag(about: dict, name: str) -> bool:
    if not isinstance(about[name], bool):
        raise ValueError(f'{name} must be true or false, got {about[name]!r}')
    return about[name]
