"""Calibration files of other programs, as what the camera_info YAML format would say of their cameras;
`docs/connect.md` has the formulae.

Every camera becomes P = K [R | t], reference frame to undistorted pixels whose centres lie at integers. Of a stereo
pair the reference frame is the optical frame of the first camera.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from .calibration import BadCalibration, Calibration, calibration_from, yaml_mapping
from .calibration_matrices import UNITS, Found, file_storage, matlab, named_cameras, npz
from .calibration_texts import NUMBER, kalibr, mayacam, ost, vtk_camera

MAX_SIZE = 10**7        # bytes; no calibration is larger
FARTHEST = 10.0         # m from the reference frame's origin to a source or camera; larger numbers are millimetres


def read_cameras(*paths: str | Path) -> list[Found]:
    """The cameras in a file in order: one, or those of a stereo pair or chain. Of OpenCV's matrices several files
    together may have them.

    Read are camera_info YAML, ROS's ost.txt, XMALab's and Autoscoper's MayaCam 2.0 and VTK cameras, Kalibr's camchain,
    OpenCV's FileStorage (YAML, XML, JSON), and npz and MAT files with OpenCV's matrices or MATLAB's stereoParameters.
    Raises BadCalibration, OSError where there is no such file, and ImportError without PyYAML.
    """
    path: str | Path = ''
    named: dict[str, object] = {}
    try:
        for path in paths:
            found = _contents(Path(path))
            if isinstance(found, list):
                if len(paths) > 1:
                    raise BadCalibration('has whole cameras in it, to which no other file adds')
                return found
            named |= found
        path = ', '.join(map(str, paths))
        return named_cameras(named)
    except BadCalibration as error:
        raise BadCalibration(f'{path}: {error}') from None
    except (TypeError, ValueError, OverflowError) as error:
        # NumPy's, of values that are no numbers or too large for one
        raise BadCalibration(f'{path}: has something in it that is no number, or no matrix') from error


def _contents(path: Path) -> list[Found] | dict[str, object]:
    """The cameras in a file, or matrices by name. Raises BadCalibration."""
    with path.open('rb') as file:
        data = file.read(MAX_SIZE + 1)
    if len(data) > MAX_SIZE:
        raise BadCalibration(f'no calibration: larger than {MAX_SIZE // 10**6} MB')
    if data.startswith((b'MATLAB 7.3', b'\x89HDF')):
        raise BadCalibration('a MAT file of version 7.3; save it with -v7')
    if data.startswith(b'MATLAB 5.0'):
        return matlab(path)
    if data.startswith(b'PK\x03\x04'):
        return npz(path)
    text = data.decode(errors='replace')
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if lines and lines[0].lower() == 'image size':
        return [mayacam(lines)]
    if text.startswith(('%YAML:', '<?xml', '<opencv_storage', '{')) or '!!opencv-matrix' in text:
        return file_storage(path)
    if '[image]' in lines:
        return ost(lines)
    if any(line.startswith('camera-position') for line in lines):
        return [vtk_camera(lines)]
    if len(lines) == 5 and all(len(re.findall(NUMBER, line)) == 3 for line in lines):
        raise BadCalibration('MayaCam 1.0, which leaves much open; XMALab and Autoscoper know MayaCam 2.0 as well')
    content = yaml_mapping(text)
    if isinstance(content.get('cam0'), dict):
        return kalibr(content)
    return [Found(calibration_from(content))]


def in_metres(cameras: list[Found], unit: str = '') -> tuple[list[Calibration], str]:
    """The calibrations of planes that belong together with lengths in m, and a line where that was not what they had.

    `unit` wins over what the files say; where neither does, cameras that would stand more than FARTHEST from the origin
    have millimetres.
    """
    said = unit or next((c.unit for c in cameras if c.unit), '')
    # what others are is said when they are used
    finite = [c.calibration.P for c in cameras if np.isfinite(c.calibration.P).all()]
    distance = max((float(np.linalg.norm(np.linalg.lstsq(P[:, :3], P[:, 3], rcond=None)[0])) for P in finite),
                   default=0.0)
    found = said or ('mm' if distance > FARTHEST else 'm')
    scaled = [dataclasses.replace(c.calibration, P=c.calibration.P * [1, 1, 1, UNITS[found]]) for c in cameras]
    if found == 'm' or unit:
        return scaled, ''
    why = 'as the file says' if said else f'as a source stands {distance:.4g} from the origin; --unit says otherwise'
    return scaled, f'the calibrations are in {found}, {why}'
