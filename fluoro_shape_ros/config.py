"""Every parameter once: default, unit, range and description. ROS parameters and docs/parameters.md are made from
here."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .device import Device, DeviceError, load_device

VISIBLE = 0.1           # m from the tip, which is what most images show of a device


class ConfigError(ValueError):
    """A parameter value that can't work; the message names the parameter and the reason."""


def _p(default: Any, description: str, *, unit: str = '', low: float | None = None, high: float | None = None,
       choices: Sequence[str] = (), element: type | None = None) -> Any:
    """A dataclass field with what people need to know of it. `element` marks a list and gives its type."""
    meta = dict(description=description, unit=unit, low=low, high=high, choices=tuple(choices), element=element)
    return field(default=default, metadata=meta)


@dataclass(frozen=True)
class InputConfig:
    """How images and cameras come in."""

    reference_frame: str = _p('', 'Frame of every result; empty: the frame_id of plane A\'s CameraInfo')
    geometry: str = _p('camera_info', 'Where a plane\'s projection comes from: the full 3x4 P of CameraInfo, '
                                      'or P\'s intrinsics and a pose from tf',
                       choices=('camera_info', 'tf'))
    rectified: bool = _p(False, 'The images are already free of distortion: ignore D')
    image_transport: str = _p('raw', 'Subscribe to image_raw, or to image_raw/compressed',
                              choices=('raw', 'compressed'))
    image_reliability: str = _p('auto', 'Reliability of the image and camera info subscriptions; '
                                        'auto: reliable, remade best-effort when that is all a publisher offers',
                                choices=('auto', 'reliable', 'best_effort'))
    sync_slop: float = _p(0.010, 'Largest difference of the stamps of a pair', unit='s', low=0.0, high=1.0)
    mask_frames: int = _p(8, 'Device-free pairs averaged into the mask image by ~/capture_mask', low=1, high=256)
    threads: int = _p(2, 'Threads that OpenCV may use; 0: as many as there are cores', low=0, high=64)
    time_budget: float = _p(0.2, 'How long the node may work on a pair before that is refused as out_of_time; '
                                 '0: no limit. Offline tools and method:=paper have none',
                            unit='s', low=0.0, high=60.0)


@dataclass(frozen=True)
class DetectionConfig:
    """How the device is found in one image."""

    image_kind: str = _p('xray', 'What the images are: X-ray images, or silhouettes, segmentations made upstream '
                                 '(0 is background, all else device; polarity does not count)',
                         choices=('xray', 'silhouette'))
    polarity: str = _p('dark', 'The device against its surroundings', choices=('dark', 'bright', 'auto'))
    device: str = _p('', 'What the device is made of, from tip to base: a YAML file, or one of braided, cannula, '
                         'cannula3, coil, ep, rod, tendon, tube; empty: unknown. '
                         f'It gives the radius, the median over {VISIBLE:g} m from the tip, and tells tip from base')
    robot_radius: float = _p(0.0006, 'Radius of the device; with the geometry it sets the filter scales. '
                                     'Where device is given, its own counts', unit='m', low=1e-5, high=0.02)
    spacing_px: float = _p(10.0, 'Spacing of the control points along the device in the image (Burgner et al. 2011)',
                           unit='px', low=1.0, high=200.0)
    min_length_px: float = _p(60.0, 'Connected curves shorter than this in an image are not the device', unit='px',
                              low=2.0, high=10000.0)


@dataclass(frozen=True)
class CurveConfig:
    """How the backbone is put together and which end is its tip."""

    method: str = _p('spline', 'spline: a 3-D spline fitted to both images at once; '
                               'paper: the published method of 2011, step by step', choices=('spline', 'paper'))
    backbone_spacing: float = _p(0.001, 'Arc-length step of the published backbone', unit='m', low=1e-5, high=0.1)
    base_position: tuple[float, ...] = _p((), 'Where the device enters, x y z in the reference frame; empty: unknown',
                                          unit='m', element=float)
    tracking: bool = _p(True, 'Start from the previous result')
    prior_max_age: float = _p(0.5, 'A predicted_backbone older than the pair by more than this is not used', unit='s',
                              low=0.0, high=60.0)
    prior_sigma: float = _p(0.010, 'Standard deviation of a predicted_backbone at its tip: '
                                   'how far tissue may push the robot from where the model has it',
                            unit='m', low=1e-4, high=0.1)


@dataclass(frozen=True)
class PlausibilityConfig:
    """When a reconstruction is believed."""

    expected_length: tuple[float, ...] = _p((), 'Shortest and longest believable length of the visible device, '
                                                '[min, max]; empty: no check', unit='m', element=float)
    max_curvature: float = _p(0.0, 'Largest believable curvature of the backbone; '
                                   '0: the rule of Burgner et al. 2011, eq. 3', unit='1/m', low=0.0, high=1e6)
    max_reprojection_px: float = _p(3.0, 'Largest believable median distance between the reprojected backbone and the '
                                         'centreline seen', unit='px', low=0.1, high=100.0)
    max_tip_sigma: float = _p(0.0, 'Largest standard deviation of the tip in its worst direction; 0: no check',
                              unit='m', low=0.0, high=1.0)
    min_confidence: float = _p(0.9, 'Least probability of being right that a backbone is published with',
                               low=0.0, high=1.0)


@dataclass(frozen=True)
class Config:
    """All parameters, a dataclass a stage. Made by `from_values`, which checks them."""

    input: InputConfig = InputConfig()
    detection: DetectionConfig = DetectionConfig()
    curve: CurveConfig = CurveConfig()
    plausibility: PlausibilityConfig = PlausibilityConfig()
    described: Device | None = None     # what the file of `device` says

    @classmethod
    def from_values(cls, **values: Any) -> Config:
        """The defaults with `values` (parameter name to value) in place of some of them.

        Raises ConfigError for an unknown name or a value that can't work.
        """
        return cls().replace(**values)

    def replace(self, **values: Any) -> Config:
        """A copy with `values` (parameter name to value) in place of the old ones; raises ConfigError."""
        unknown = set(values) - {f.name for f in fields()}
        if unknown:
            raise ConfigError(f'no such parameter: {", ".join(sorted(unknown))}')
        stages = {}
        for stage in _stages():
            old = getattr(self, stage.name)
            new = {f.name: _checked(f, values[f.name]) for f in dataclasses.fields(old) if f.name in values}
            stages[stage.name] = dataclasses.replace(old, **new)
        return Config(**stages, described=_described(values['device']) if 'device' in values else self.described)

    def values(self) -> dict:
        """Parameter name to value, in the order of declaration."""
        return {f.name: getattr(getattr(self, stage.name), f.name)
                for stage in _stages() for f in dataclasses.fields(getattr(self, stage.name))}

    @property
    def radius(self) -> float:
        """m, of what is looked for: robot_radius, or that of the device which is described."""
        return self.detection.robot_radius if self.described is None else visible_radius(self.described)


def fields() -> list[dataclasses.Field]:
    """Every parameter as a dataclass field; `metadata` has description, unit, low, high, choices and element."""
    default = Config()
    return [f for stage in _stages() for f in dataclasses.fields(getattr(default, stage.name))]


def _stages() -> list[dataclasses.Field]:
    return [f for f in dataclasses.fields(Config) if f.name != 'described']


def _described(name: str) -> Device | None:
    """The device of a file or preset; None for no name. Raises ConfigError."""
    try:
        return load_device(name) if name else None
    except DeviceError as error:
        raise ConfigError(f'device: {error}') from error


def visible_radius(device: Device) -> float:
    """m: the median along what images show of a device's shaft."""
    shaft = sorted(Device(device.segments).pieces(min(VISIBLE, device.length)), key=lambda piece: piece.radius)
    total = np.cumsum([piece.stop - piece.start for piece in shaft])
    return shaft[int(np.searchsorted(total, total[-1] / 2))].radius


def constraint(f: dataclasses.Field) -> str:
    """What else a value of parameter `f` must be, in words; empty where its type and range say it all."""
    m = f.metadata
    if m['choices']:
        return f'one of: {", ".join(m["choices"])}'
    if m['element'] is None:
        return ''
    lengths, _, reason = _LISTS[f.name]
    return ', '.join(filter(None, (f'none or {max(lengths)} numbers', reason)))


# what a list parameter must look like beyond its element type: name -> (allowed lengths, rule, reason)
_LISTS = {
    'base_position': ((0, 3), lambda v: True, ''),
    'expected_length': ((0, 2), lambda v: not v or 0 <= v[0] < v[1], '0 <= min < max'),
}


def _checked(f: dataclasses.Field, value: Any) -> Any:
    """`value` in the type of field `f`, or ConfigError with name and reason."""
    m = f.metadata
    if m['element'] is not None:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f'{f.name}: needs a list of numbers, got {value!r}')
        value = tuple(_number(f.name, v) for v in value)
        lengths, rule, reason = _LISTS[f.name]
        if len(value) not in lengths:
            raise ConfigError(f'{f.name}: needs {" or ".join(map(str, lengths))} numbers, got {len(value)}')
        if not rule(value):
            raise ConfigError(f'{f.name}: needs {reason}, got {list(value)}')
        return value
    kind = type(f.default)
    if kind is float:
        value = _number(f.name, value)
    elif type(value) is not kind:
        raise ConfigError(f'{f.name}: needs a {kind.__name__}, got {value!r}')
    if m['choices'] and value not in m['choices']:
        raise ConfigError(f'{f.name}: must be one of {", ".join(m["choices"])}, got {value!r}')
    if m['low'] is not None and not m['low'] <= value <= m['high']:
        unit = f' {m["unit"]}' if m['unit'] else ''
        raise ConfigError(f'{f.name}: must lie in [{m["low"]:g}, {m["high"]:g}]{unit}, got {value:g}')
    return value


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ConfigError(f'{name}: needs a finite number, got {value!r}')
    return float(value)
