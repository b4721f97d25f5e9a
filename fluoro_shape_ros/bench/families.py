"""Families of seeded scenes with known truth, by name: what the benches report on.

ACCURACY scenes have nothing in them but the device, so that the Cramer-Rao bound applies. ROBUSTNESS scenes are X-ray
images over anatomy (0.3 mm a pixel, planes 90 degrees apart, 1500 photons a pixel, 25 % contrast), each with one more
difficulty. HARDER ones show what a prediction is worth. `variety` draws everything at random: device, geometry,
anatomy, physics of the image and display; see sim/variety.py.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..cli import ToolError
from ..data import Frame
from ..device import presets
from ..sim import carm, ct, placement, scenes, xray
from ..sim import variety as wide
from ..sim.scenes import Run
from .case import Case, Family
from .composites import composite
from .open_scenes import open_family

HIDDEN_PX = 25.0                            # of the device, behind the occluder
CALIBRATION_ERROR_PX = 0.5
ANGLES = np.deg2rad((35.0, 125.0))          # between the planes
LOW_DOSE, FAINT = 150.0, 37.5               # photons a pixel
MASK_FRAMES, MASK_SHIFT_PX = 8, 1.5         # frames averaged; the most that the patient has moved since, along u and v
SHORT, LONG = (0.067, 0.150), (0.140, 0.188)    # m: fits the field of 0.2 mm/px; room for a loop


@dataclass(frozen=True)
class Sources:
    """Files that only some families are made from."""

    ct: Path | None = None      # a CT volume; see sim/ct.py
    open: Path | None = None    # a folder of scenes; see open_scenes.py


def families(real: Path | None = None) -> dict[str, Family]:
    """All families by name; those on real backgrounds exist where their folder `real` is given."""
    return ACCURACY | ROBUSTNESS | HARDER | (on_real(real) if real else {})


def varied(sources: Sources = Sources()) -> dict[str, Family]:
    """The families drawn from a world as wide as the clinic; some exist only where their source is given."""
    found = {
        'wide': Family('a solid rod: radius, contrast, geometry, dose, blur, scatter and display drawn',
                       lambda seed: _varied(wide.wide_run(seed))),
        'wide_anatomy': Family('the same before drawn anatomy',
                               lambda seed: _varied(wide.wide_run(seed, anatomy=True))),
        'wide_blank': Family('the same without the rod', lambda seed: _without(_rod_run(seed)), device=False),
        'wide_one_plane': Family('the same with the rod in one plane only', lambda seed: _in_one_plane(_rod_run(seed)),
                                 device=False),
        'wide_unpaired': Family('the same with another rod in plane B: images of different moments',
                                lambda seed: _unpaired(_rod_run(seed)), device=False),
        'devices': Family(f'{", ".join(presets())}, in turn, before drawn anatomy',
                          lambda seed: _varied(wide.device_run(seed), kind=True)),
        'gvxr': Family('tubes and rods in tissue, drawn by gVirtualXray at 0.2 mm a pixel',
                       lambda seed: _varied(wide.gvxr_run(seed), kind=True)),
    }
    if sources.ct:
        found |= {
            'ct': Family('the same devices in a CT, every second one entering through the border',
                         lambda seed: _varied(wide.ct_run(seed, _volume(sources.ct)), kind=True)),
            'ct_none': Family('the same without the device',
                              lambda seed: _without(wide.ct_run(seed, _volume(sources.ct))), device=False),
        }
    return found | ({'open': open_family(sources.open)} if sources.open else {})


def _varied(run: Run, kind: bool = False) -> Case:
    return Case(run.scene(), note=run.said(), run=run, kind=run.name if kind else '')


def _without(run: Run) -> Case:
    return Case(dataclasses.replace(run.scene(), frame=run.without_device(index=1)), note=run.said())


def _rod_run(seed: int) -> Run:
    return wide.wide_run(seed, anatomy=bool(seed // 2 % 2))


def _in_one_plane(run: Run) -> Case:
    scene, seen = run.scene(), run.seed % 2
    images = [scene.frame.images[i] if i == seen else run.without_device(index=1).images[i] for i in (0, 1)]
    return Case(dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, images=tuple(images))),
                note=f'device in plane {"ab"[seen]} only')


def _unpaired(run: Run) -> Case:
    shape, shaft = placement.place(np.random.default_rng([run.seed, 11]), run.fields, 'spline',
                                   (run.shape.length / 2, run.shape.length), bool(run.shaft))
    scene, other = run.scene(), dataclasses.replace(run, shape=shape, shaft=shaft).scene(index=1)
    return Case(dataclasses.replace(scene, frame=dataclasses.replace(
        scene.frame, images=(scene.frame.images[0], other.frame.images[1]))), note='another device in plane b')


def _volume(file: Path) -> ct.Volume:
    try:
        return ct.load_ct(file)
    except ct.CtError as error:
        raise ToolError(str(error)) from error


def on_real(folder: Path) -> dict[str, Family]:
    """Families of composites on the backgrounds in `folder`; see composites.py."""
    def case(seed: int, **options) -> Case:
        return Case(*composite(seed, folder, **options))
    return {
        'real': Family('a device on real backgrounds', case),
        'real_mask': Family('the same scenes, with a mask', lambda seed: case(seed, masked=True)),
        'real_blank': Family('real backgrounds without a device', lambda seed: case(seed, device=False), device=False),
    }


def _bare(run: Run) -> Case:
    return Case(run.scene(), run=run)


def _xray(seed: int, *, pixel_size_iso: float = 0.3e-3, angle: float = np.pi / 2, photons: float = 1500.0,
          **options) -> Run:
    views = carm.biplane(angle_b=(angle, 0.0), arm=carm.CArm(pixel_size_iso=pixel_size_iso))
    return scenes.xray_run(seed, views=views, exposure=xray.Exposure(photons=photons), **options)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, 6])     # apart from those that draw the scene


def _cluttered(seed: int) -> Case:
    clutter = ('leads', 'wire', 'text', ('blades', 'field')[seed % 2])
    return Case(_xray(seed, clutter=clutter).scene(), note=', '.join(clutter))


def _masked(seed: int) -> Case:
    run, shifts = _xray(seed, clutter=('leads', 'wire')), _rng(seed).uniform(-MASK_SHIFT_PX, MASK_SHIFT_PX, (2, 2))
    frames = [run.without_device(index=k + 1).images for k in range(MASK_FRAMES)]
    means = [np.mean(images, axis=0, dtype=np.float32) for images in zip(*frames)]
    masks = tuple(_moved(mean, shift) for mean, shift in zip(means, shifts))
    return Case(run.scene(), masks, 'masks moved by ' + ' and '.join(f'{np.linalg.norm(d):.1f} px' for d in shifts))


def _moved(image: np.ndarray, shift_px: np.ndarray) -> np.ndarray:
    return cv2.warpAffine(image, np.c_[np.eye(2), shift_px], image.shape[::-1], flags=cv2.INTER_CUBIC,
                          borderMode=cv2.BORDER_REPLICATE)


def _angled(seed: int) -> Case:
    angle = _rng(seed).uniform(*ANGLES)
    return Case(_xray(seed, angle=angle).scene(), note=f'planes {np.rad2deg(angle):.0f} degrees apart')


def _miscalibrated(seed: int) -> Case:
    """The scene of the same seed of `anatomy`, but plane B's principal point is not quite where its calibration
    says."""
    scene, turn = _xray(seed).scene(), _rng(seed).uniform(0, 2 * np.pi)
    a, b = scene.frame.views
    shift = np.array([np.cos(turn), np.sin(turn), 0.0]) * CALIBRATION_ERROR_PX
    wrong = dataclasses.replace(b, P=b.P + np.outer(shift, b.P[2]))
    frame = dataclasses.replace(scene.frame, views=(a, wrong))
    return Case(dataclasses.replace(scene, frame=frame), note=f'plane b off by {shift[0]:.2f}, {shift[1]:.2f} px')


def _plain_or_anatomy(seed: int) -> tuple[Run, str]:
    """Three kinds of run in turn, and what they are."""
    kind = seed // 2 % 3
    if kind == 0:
        return scenes.protocol_p_run(seed, 'xray'), 'protocol P'
    return (_xray(seed), 'anatomy') if kind == 1 else (_xray(seed, clutter=('leads', 'text', 'blades')),
                                                       'anatomy, leads, text, blades')


def _blank(seed: int) -> Case:
    run, what = _plain_or_anatomy(seed)
    return Case(dataclasses.replace(run.scene(), frame=run.without_device(index=1)), note=what)


def _one_plane(seed: int) -> Case:
    run, what = _plain_or_anatomy(seed)
    scene, without = run.scene(), run.without_device(index=1)
    seen = seed % 2
    images = (scene.frame.images[0], without.images[1]) if seen == 0 else (without.images[0], scene.frame.images[1])
    frame = Frame(scene.frame.stamp_ns, scene.frame.frame_id, images, scene.frame.views)
    return Case(dataclasses.replace(scene, frame=frame), note=f'{what}; device in plane {"ab"[seen]} only')


ACCURACY = {
    'p': Family('protocol P of Burgner et al. 2011, drawn by VTK', lambda seed: _bare(scenes.protocol_p_run(seed))),
    'p_xray': Family('protocol P, drawn by the X-ray renderer',
                     lambda seed: _bare(scenes.protocol_p_run(seed, 'xray'))),
    'xray_02': Family('X-ray at 0.2 mm a pixel',
                      lambda seed: _bare(_xray(seed, anatomy=False, pixel_size_iso=0.2e-3, lengths=SHORT))),
    'xray_03': Family('X-ray at 0.3 mm a pixel', lambda seed: _bare(_xray(seed, anatomy=False))),
    'low_dose': Family('X-ray at 0.3 mm a pixel, a tenth of the dose',
                       lambda seed: _bare(_xray(seed, anatomy=False, photons=LOW_DOSE))),
}
ROBUSTNESS = {
    'anatomy': Family('ribs, spine, vessels, soft tissue', lambda seed: Case(_xray(seed).scene())),
    'clutter': Family('and ECG leads, a second wire, text, blades or a circular field', _cluttered),
    'masked': Family('leads and a second wire, with a mask of a patient who has moved', _masked),
    'angles': Family('planes 35 to 125 degrees apart', _angled),
    'tangent': Family('device tangent to its epipolar lines, which meet it twice',
                      lambda seed: Case(_xray(seed, kind='tangent').scene())),
    'crossing': Family('device crosses itself in an image',
                       lambda seed: Case(_xray(seed, kind='crossing', lengths=LONG).scene())),
    'occlusion': Family(f'{HIDDEN_PX:g} px of the device hidden in one plane',
                        lambda seed: Case(_xray(seed, hidden_px=HIDDEN_PX).scene())),
    'entering': Family('shaft comes in through the border', lambda seed: Case(_xray(seed, entering=True).scene())),
    'calibration': Family(f'plane B\'s calibration off by {CALIBRATION_ERROR_PX:g} px; else the scenes of anatomy',
                          _miscalibrated),
    'blank': Family('no device', _blank, device=False),
    'one_plane': Family('device in one plane only', _one_plane, device=False),
}
HARDER = {
    'faint': Family('X-ray at 0.3 mm a pixel, a fortieth of the dose',
                    lambda seed: _bare(_xray(seed, anatomy=False, photons=FAINT))),
}
