"""Cameras from the text files of X-ray labs (XMALab, Autoscoper), of ROS and of Kalibr."""

from __future__ import annotations

import re

import numpy as np

from .calibration import BadCalibration, Calibration
from .calibration_matrices import Found, assembled, model_of
from .messages import short

NUMBER = r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?'


def mayacam(lines: list[str]) -> Found:
    """MayaCam 2.0: sections 'image size' (width, height), 'camera matrix', 'rotation', 'translation': K, R and t of
    OpenCV."""
    sections: dict[str, list[float]] = {}
    name = ''
    for line in lines:
        if re.fullmatch('[a-z ]+', line.lower()):
            name = line.lower()
            sections[name] = []
        else:
            sections[name] += map(float, re.findall(NUMBER, line))
    size, K, R, t = (sections.get(key, []) for key in ('image size', 'camera matrix', 'rotation', 'translation'))
    for key, values, count in (('image size', size, 2), ('camera matrix', K, 9), ('rotation', R, 9),
                               ('translation', t, 3)):
        if len(values) != count:
            raise BadCalibration(f'MayaCam 2.0: {key} has {len(values)} numbers instead of {count}')
    D = sections.get('distortion', [])
    return assembled('', (int(size[0]), int(size[1])), np.reshape(K, (3, 3)), D, model_of(D), np.reshape(R, (3, 3)), t)


def vtk_camera(lines: list[str]) -> Found:
    """Autoscoper's VTK camera: where it stands, where it looks, what is up, and its angle of view in degrees, as far as
    width and height each."""
    values = {key.strip(): [float(v) for v in re.findall(NUMBER, value)]
              for key, _, value in (line.partition(':') for line in lines if not line.startswith('#'))}
    counts = {'camera-position': 3, 'focal-point': 3, 'view-up': 3, 'view-angle': 1, 'image-width': 1,
              'image-height': 1}
    for key, count in counts.items():
        if len(values.get(key, ())) != count:
            raise BadCalibration(f'VTK camera: {key} has {len(values.get(key, ()))} numbers instead of {count}')
    position, focus, up = (np.array(values[key]) for key in ('camera-position', 'focal-point', 'view-up'))
    size = np.array([values['image-width'][0], values['image-height'][0]])
    forward, right = focus - position, np.cross(focus - position, up)
    if not (np.linalg.norm(forward) and np.linalg.norm(right)) or not 0 < values['view-angle'][0] < 180:
        raise BadCalibration('VTK camera: it looks nowhere')
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    f = size / (2 * np.tan(np.deg2rad(values['view-angle'][0]) / 2))
    K = np.array([[f[0], 0, (size[0] - 1) / 2], [0, f[1], (size[1] - 1) / 2], [0, 0, 1]])
    return assembled('', (int(size[0]), int(size[1])), K, [], '', R, -R @ position)


# ---- ROS and Kalibr


def ost(lines: list[str]) -> list[Found]:
    """ROS's ost.txt (INI): [image] with width and height, then a section a camera with camera matrix, distortion,
    rectification and projection."""
    sections: dict[str, dict[str, list[float]]] = {}
    cameras, name, key = [], '', ''
    for line in lines:
        if line.startswith('#'):
            continue
        if line.startswith('['):
            name = line.strip('[]')
            sections.setdefault(name, {})
        elif re.fullmatch('[a-z ]+', line.lower()):
            key = line.lower()
            sections.setdefault(name, {})[key] = []
        else:
            sections.setdefault(name, {}).setdefault(key, []).extend(map(float, re.findall(NUMBER, line)))
    width, height = (int((sections.get('image', {}).get(key) or [0])[0]) for key in ('width', 'height'))
    for name, section in sections.items():
        if 'projection' not in section:
            continue
        parts = {key: section.get(long, []) for key, long in (('K', 'camera matrix'), ('R', 'rectification'),
                                                              ('P', 'projection'), ('D', 'distortion'))}
        if [len(parts[key]) for key in 'KRP'] != [9, 9, 12]:
            raise BadCalibration(f'[{short(name)}] needs camera matrix, rectification and projection')
        cameras.append(Found(Calibration(name, width, height, np.reshape(parts['K'], (3, 3)),
                                         np.reshape(parts['P'], (3, 4)), model_of(parts['D']), np.array(parts['D']),
                                         np.reshape(parts['R'], (3, 3)))))
    if not cameras:
        raise BadCalibration('no camera with a projection in it')
    return cameras


def kalibr(content: dict) -> list[Found]:
    """Kalibr's camchain: each camera's pose is that of the one before, T_cn_cnm1, m."""
    cameras: list[Found] = []
    pose = np.eye(4)
    while isinstance(camera := content.get(f'cam{len(cameras)}'), dict):
        name = f'cam{len(cameras)}'
        try:
            if camera.get('camera_model') != 'pinhole':
                raise BadCalibration(f'{name} is {short(str(camera.get("camera_model")))}; '
                                     'only pinhole cameras are read')
            if cameras:
                pose = np.array(camera['T_cn_cnm1'], float).reshape(4, 4) @ pose
            (fu, fv, cu, cv), (width, height) = map(float, camera['intrinsics']), map(int, camera['resolution'])
            D, model = (np.array(camera.get('distortion_coeffs') or [], float),
                        str(camera.get('distortion_model', 'none')))
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, BadCalibration):
                raise
            raise BadCalibration(f'{name} needs intrinsics, resolution and, but the first, T_cn_cnm1') from None
        model = {'radtan': 'plumb_bob', 'none': ''}.get(model, model)
        cameras.append(assembled(name, (width, height), [[fu, 0, cu], [0, fv, cv], [0, 0, 1]], D, model, pose[:3, :3],
                                 pose[:3, 3], 'm'))
    return cameras
