"""Camera calibration files in the camera_info YAML format, as camera_calibration writes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .messages import New, header


class BadCalibration(ValueError):
    """A calibration file that can't be used; the message names the file and the field."""


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says of one plane; the fields of sensor_msgs/CameraInfo that do not change from image to
    image."""

    camera_name: str
    width: int          # px
    height: int         # px
    K: np.ndarray       # (3, 3) intrinsics of the raw image, px
    P: np.ndarray       # (3, 4) projection, reference frame (m) to pixels
    distortion_model: str = ''
    D: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (n,) coefficients
    R: np.ndarray = field(default_factory=lambda: np.eye(3))    # (3, 3) rectifying rotation


# attribute of Calibration -> name in the file and shape
_MATRICES = {'K': ('camera_matrix', (3, 3)), 'P': ('projection_matrix', (3, 4)), 'R': ('rectification_matrix', (3, 3)),
             'D': ('distortion_coefficients', None)}


def read_calibration(path: str | Path) -> Calibration:
    """The calibration in the file `path`; `calibration_files` reads those of other programs.

    `rectification_matrix`, `distortion_model` and `distortion_coefficients` may be missing: none. Whether it can be a
    camera is for `camera_info_to_view` to say. Raises BadCalibration, OSError where there is no such file and
    ImportError without PyYAML.
    """
    try:
        return calibration_from(yaml_mapping(Path(path).read_bytes().decode()))
    except UnicodeDecodeError as error:
        raise BadCalibration(f'{path}: no YAML ({error})') from error
    except BadCalibration as error:
        raise BadCalibration(f'{path}: {error}') from None


def yaml_mapping(text: str) -> dict:
    """What a YAML text has by name. Raises BadCalibration and ImportError without PyYAML."""
    import yaml  # the only user of PyYAML among the adapters, which all else does without

    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise BadCalibration(f'no YAML ({" ".join(str(error).split())})') from error
    if not isinstance(content, dict):
        raise BadCalibration('no calibration: the camera_info YAML format has fields by name')
    return content


def calibration_from(content: dict) -> Calibration:
    """The calibration in the fields of the camera_info YAML format. Raises BadCalibration."""
    try:
        matrices = {key: _matrix(content[name], shape, name) for key, (name, shape) in _MATRICES.items()
                    if name in content or key in ('K', 'P')}
        return Calibration(camera_name=str(content.get('camera_name', '')),
                           width=_size(content['image_width'], 'image_width'),
                           height=_size(content['image_height'], 'image_height'),
                           distortion_model=str(content.get('distortion_model') or ''), **matrices)
    except KeyError as error:
        raise BadCalibration(f'{error.args[0]} is missing') from None


def _matrix(entry: Any, shape: tuple[int, int] | None, name: str) -> np.ndarray:
    try:
        values = np.array(entry['data'], float)     # numbers as 1e-05, which YAML 1.1 takes for text, included
    except (TypeError, ValueError, KeyError, IndexError):
        raise BadCalibration(f'{name} needs rows, cols and data, a list of numbers') from None
    if shape is None:
        return values.ravel()
    if values.size != shape[0] * shape[1]:
        raise BadCalibration(f'{name} has {values.size} entries instead of {shape[0]}x{shape[1]}')
    return values.reshape(shape)


def _size(value: Any, name: str) -> int:
    if type(value) is not int or value < 1:
        raise BadCalibration(f'{name} must be a positive whole number, not {value!r}')
    return value


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write `calibration` to the file `path`, which `read_calibration` and camera_info_manager read."""
    import yaml

    def entry(m: ArrayLike) -> dict[str, object]:
        m = np.atleast_2d(m)
        return {'rows': m.shape[0], 'cols': m.shape[1], 'data': m.ravel().tolist()}

    content = {'image_width': calibration.width, 'image_height': calibration.height,
               'camera_name': calibration.camera_name, 'distortion_model': calibration.distortion_model}
    content |= {name: entry(getattr(calibration, key)) for key, (name, _) in _MATRICES.items()}
    Path(path).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def calibration_to_camera_info(calibration: Calibration, stamp_ns: int, frame_id: str, new: New) -> Any:
    """A sensor_msgs/CameraInfo of the full image; `new` is a factory (see messages)."""
    c = calibration
    return new('sensor_msgs/msg/CameraInfo', header=header(new, stamp_ns, frame_id), width=c.width, height=c.height,
               distortion_model=c.distortion_model, d=c.D, k=c.K, r=c.R, p=c.P)
