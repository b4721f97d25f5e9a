"""Cameras from matrices that have names: OpenCV's FileStorage, npz and MAT files, and MATLAB's stereoParameters."""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .calibration import BadCalibration, Calibration
from .messages import short

UNITS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'in': 0.0254}
WORDS = {'meters': 'm', 'metres': 'm', 'meter': 'm', 'metre': 'm', 'centimeters': 'cm', 'centimetres': 'cm',
         'millimeters': 'mm', 'millimetres': 'mm', 'millimeter': 'mm', 'millimetre': 'mm', 'inches': 'in', 'inch': 'in',
         '"': 'in'} | {unit: unit for unit in UNITS}


@dataclass(frozen=True)
class Found:
    """A camera of a file."""

    calibration: Calibration    # of width and height 0 where the file does not say how large its images are
    unit: str = ''              # of the lengths in it; '': the file does not say


def assembled(name: str, size: tuple[int, int], K: Any, D: ArrayLike, model: str, R: Any, t: Any,
              unit: str = '') -> Found:
    """A camera from its matrices. Raises BadCalibration where they have another shape."""
    K, R, t = (np.asarray(m, float) for m in (K, R, t))
    if R.size == 3:
        R = cv2.Rodrigues(R.reshape(3))[0]
    if K.shape != (3, 3) or R.shape != (3, 3) or t.size != 3:
        raise BadCalibration(f'camera matrix, rotation and translation are {K.shape}, {R.shape} and {t.shape}, '
                             'not 3x3, 3x3 and 3')
    if np.isfinite(R).all() and np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
        raise BadCalibration('its rotation is none')
    return Found(Calibration(name, *size, K, K @ np.c_[R, t.reshape(3)], model, np.ravel(np.asarray(D, float))), unit)


# ---- OpenCV's matrices by name

K_NAMES = ('k', 'm', 'mtx', 'cameramatrix', 'intrinsic', 'intrinsics', 'intrinsicmatrix', 'matrix', 'cammat', 'cammtx')
D_NAMES = ('d', 'dist', 'distcoeffs', 'distcoeff', 'distcoefs', 'distortion', 'distortioncoefficients',
           'distortioncoeffs', 'coeffs')
R_NAMES = ('r', 'rot', 'rmat', 'rotation', 'rotationmatrix', 'rvec')
T_NAMES = ('t', 'trans', 'tvec', 'translation', 'translationvector', 'tvect')
SIDES = (('1', 'l', 'left', 'a', 'cam1', 'camera1'), ('2', 'r', 'right', 'b', 'cam2', 'camera2'))
SIDES_FROM_0 = (('0', 'cam0', 'camera0'), ('1', 'cam1', 'camera1'))


def named_cameras(named: dict[str, Any]) -> list[Found]:
    """K and D of one camera, or of two with R and T from the first to the second, whatever their names; alone, R and T
    take the reference frame to the camera.

    Raises BadCalibration where that is not there.
    """
    plain = {re.sub('[^a-z0-9]', '', name.lower()): value for name, value in named.items()}
    R, t = (next((plain[name] for name in names if name in plain), None) for names in (R_NAMES, T_NAMES))
    sides = SIDES if _of_side(plain, K_NAMES, SIDES_FROM_0[0]) is None else SIDES_FROM_0
    pair = [_of_side(plain, K_NAMES, side) for side in sides]
    if all(K is not None for K in pair):
        if R is None or t is None:
            raise BadCalibration('has two cameras, but not R and T from the first to the second; '
                                 'give the file that has them after it')
        poses = ((np.eye(3), np.zeros(3)), (R, t))
        coefficients = [_of_side(plain, D_NAMES, side, ()) for side in sides]
        return [assembled('', _size(plain, side), K, D, model_of(D, plain), *pose)
                for K, D, side, pose in zip(pair, coefficients, sides, poses)]
    K = next((plain[name] for name in K_NAMES if name in plain), None)
    P = next((np.asarray(plain[name], float) for name in ('projectionmatrix', 'projection', 'p') if name in plain),
             None)
    D = next((plain[name] for name in D_NAMES if name in plain), ())
    if K is not None and R is not None and t is not None:
        return [assembled('', _size(plain, ()), K, D, model_of(D, plain), R, t)]
    if K is not None and P is not None and P.shape == (3, 4) and np.shape(K) == (3, 3):
        return [Found(Calibration('', *_size(plain, ()), np.asarray(K, float), P, model_of(D, plain),
                                  np.ravel(np.asarray(D, float))))]
    names = ', '.join(map(short, named)) or 'nothing'
    raise BadCalibration(f'no K, D, R and T of a camera or of a stereo pair; it has {names[:120]}')


def _of_side(plain: dict, names: tuple[str, ...], side: tuple[str, ...], default: Any = None) -> Any:
    """What one of the names means with a side before or after it."""
    return next((plain[key] for name in names for s in side for key in (name + s, s + name) if key in plain), default)


def _size(plain: dict, side: tuple[str, ...]) -> tuple[int, int]:
    """Width and height of the images in px; 0, 0 where they are not said. NumPy's shapes have the height first."""
    for names, first in ((('imagesize', 'imgsize', 'imsize', 'size', 'resolution'), 0),
                         (('imageshape', 'imgshape', 'shape'), 1)):
        values = _of_side(plain, names, ('', *side))
        if values is not None and np.size(values) >= 2:
            return int(np.ravel(values)[first]), int(np.ravel(values)[1 - first])
    values = [_of_side(plain, names, ('', *side))
              for names in (('imagewidth', 'width', 'imgwidth', 'w'), ('imageheight', 'height', 'imgheight', 'h'))]
    return (0, 0) if None in values else (int(np.ravel(values[0])[0]), int(np.ravel(values[1])[0]))


def model_of(D: ArrayLike, plain: dict | None = None) -> str:
    """The distortion model of OpenCV's coefficients, as the file says or by their number."""
    said = (plain or {}).get('distortionmodel')
    if said is not None:
        return str(said)
    if (plain or {}).get('fisheyemodel'):
        return 'equidistant'
    return 'rational_polynomial' if np.size(D) > 5 else 'plumb_bob'


def file_storage(path: Path) -> dict[str, object]:
    """The top level of OpenCV's FileStorage. Raises BadCalibration."""
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        root = storage.root()
        return {name: _node(root.getNode(name)) for name in root.keys()}     # noqa: SIM118 (no dict)
    except (cv2.error, SystemError, MemoryError):
        raise BadCalibration('can\'t be read as OpenCV writes YAML, XML or JSON') from None


def _node(node: Any) -> Any:
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_node(node.at(k)) for k in range(min(node.size(), 64))]
    return node.mat() if node.isMap() and not node.getNode('data').empty() else ()


def npz(path: Path) -> dict[str, object]:
    """The arrays in an npz file. Raises BadCalibration."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] if arrays[name].ndim else arrays[name].item() for name in arrays.files}
    except (ValueError, OSError, EOFError, MemoryError, zipfile.BadZipFile):
        raise BadCalibration('can\'t be read as the arrays of an npz file') from None


# ---- MATLAB

HOW = 's = toStruct(stereoParams); save(\'stereo.mat\', \'-struct\', \'s\')'


def matlab(path: Path) -> list[Found] | dict[str, object]:
    """stereoParameters as a struct, or OpenCV's matrices by name. Raises BadCalibration, also for objects, which only
    MATLAB can open."""
    from scipy.io import loadmat
    try:
        content = {name: value for name, value in loadmat(path, simplify_cells=True).items()
                   if not name.startswith('__')}
    except Exception:       # on a damaged file scipy raises anything
        raise BadCalibration('can\'t be read as a MAT file') from None
    for candidate in (content, *content.values()):
        if isinstance(candidate, dict) and 'CameraParameters1' in candidate:
            return stereo_parameters(candidate)
    if not content or any(type(value).__name__ == 'MatlabOpaque'
                          or getattr(getattr(value, 'dtype', None), 'names', None) for value in content.values()):
        raise BadCalibration(f'has an object in it that only MATLAB can open; there: {HOW}')
    return content


def stereo_parameters(s: dict) -> list[Found]:
    """A pair from toStruct: MATLAB multiplies rows from the left and counts pixels from 1."""
    cameras = []
    for number in (1, 2):
        try:
            c = s[f'CameraParameters{number}']
            K = np.array(c['K'] if 'K' in c else np.transpose(c['IntrinsicMatrix']), float) - [[0, 0, 1], [0, 0, 1],
                                                                                               [0, 0, 0]]
            radial, (p1, p2) = ([*np.ravel(c['RadialDistortion']).tolist(), 0.0][:3],
                                np.ravel(c['TangentialDistortion']).tolist())
            R, t = (np.eye(3), np.zeros(3)) if number == 1 else (np.transpose(s['RotationOfCamera2']),
                                                                 s['TranslationOfCamera2'])
            height, width = map(int, np.ravel(c['ImageSize'])) if np.size(c.get('ImageSize', ())) == 2 else (0, 0)
        except (KeyError, TypeError, ValueError):
            raise BadCalibration(f'stereoParameters: CameraParameters{number} is not as toStruct makes it') from None
        unit = WORDS.get(str(c.get('WorldUnits', '')).strip().lower(), '')
        cameras.append(assembled('', (width, height), K, [*radial[:2], p1, p2, radial[2]], 'plumb_bob', R, t, unit))
    return cameras
