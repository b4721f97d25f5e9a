"""sensor_msgs/CameraInfo to the View of a plane.

Any object with the fields of the message will do: rclpy's and rosbags' messages alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fluoro_shape_ros.data import Distortion, View
from fluoro_shape_ros.geometry.cameras import GeometryError, decompose, make_view

from .messages import short

LARGEST = 1e12      # no entry of a camera's matrices is beyond that, and arithmetic with it does not overflow
LONGEST = 256       # characters of a frame_id, which every message of a result repeats, or of a model;
                    # coefficients of any kind
NO_POSE = 1e-6         # rad and m: a pose smaller than that is none
MOST_COEFFICIENTS = 14      # that OpenCV knows
# how many D may have, but for zeros after them
COEFFICIENTS = {'plumb_bob': (4, 5), 'rational_polynomial': (8, 12, 14), 'equidistant': (4,)}
NAMES = {'fisheye': 'equidistant'}      # of models that others call otherwise


class BadCameraInfo(ValueError):
    """A CameraInfo that can't be a camera, or not this image's; the message tells why."""


def check_lengths(msg: Any, name: str) -> None:
    """Raises BadCameraInfo where what has no limit in plane `name`'s sensor_msgs/CameraInfo is too long to be kept,
    compared and repeated."""
    if len(msg.header.frame_id) > LONGEST:
        raise BadCameraInfo(f'plane {name}: its frame_id has {len(msg.header.frame_id)} characters, '
                            f'more than {LONGEST}')
    if len(msg.distortion_model) > LONGEST:
        raise BadCameraInfo(f'plane {name}: distortion model "{short(msg.distortion_model)}" has '
                            f'{len(msg.distortion_model)} characters, more than {LONGEST}')
    if len(msg.d) > LONGEST or len(msg.d) > MOST_COEFFICIENTS and any(msg.d):     # zeros are a pinhole, however many
        raise BadCameraInfo(f'plane {name}: D has {len(msg.d)} coefficients, more than {MOST_COEFFICIENTS}')


def camera_info_to_view(msg: Any, name: str, image_shape: tuple[int, int], *, rectified: bool = False,
                        pose: tuple[np.ndarray, np.ndarray] | None = None) -> View:
    """The View of plane `name` ('a' or 'b') for an image of `image_shape` (H, W) as received, from a
    sensor_msgs/CameraInfo.

    `P` maps the reference frame (m) to pixels; with `pose`, a pair R (3, 3), t (3,) of camera_from_reference, only its
    left 3x3 counts. `rectified` says that the image is free of distortion already: D and R are ignored. K and P refer
    to the full resolution; the image may be a region of it (`roi`) and binned. Raises BadCameraInfo.
    """
    try:
        to_image = _image_from_full(msg, image_shape)
        K, P = _matrix(msg.k, 'K', (3, 3)), _matrix(msg.p, 'P', (3, 4))
        distortion = None if rectified else _distortion(msg, to_image @ K)
        if pose is not None:
            P = _intrinsics(P[:, :3]) @ np.c_[pose[0], pose[1]]
    except BadCameraInfo as error:
        raise BadCameraInfo(f'plane {name}: {error}') from None
    try:
        return make_view(name, to_image @ P, image_shape[1], image_shape[0], distortion)
    except GeometryError as error:
        raise BadCameraInfo(str(error)) from error


def has_pose(msg: Any) -> bool:
    """Whether P of a valid sensor_msgs/CameraInfo is not K [I | 0]: it takes points from another frame than the
    camera's own."""
    _, R, t = decompose(np.reshape(msg.p, (3, 4)).astype(float))
    return bool(np.abs(R - np.eye(3)).max() > NO_POSE or np.abs(t).max() > NO_POSE)


def _image_from_full(msg: Any, image_shape: tuple[int, int]) -> np.ndarray:
    """(3, 3) homography from pixels of the full resolution to those of the received image, whose size it checks."""
    full = np.array([msg.width, msg.height], float)
    if not full.all():
        raise BadCameraInfo(f'the size in CameraInfo is {msg.width}x{msg.height}')
    offset = np.array([msg.roi.x_offset, msg.roi.y_offset], float)
    region = np.where([msg.roi.width, msg.roi.height], [msg.roi.width, msg.roi.height], full)   # 0: all of it
    if (offset + region > full).any():
        raise BadCameraInfo(f'its roi ({region[0]:g}x{region[1]:g} at {offset[0]:g}, '
                            f'{offset[1]:g}) leaves the sensor ({msg.width}x{msg.height})')
    binning = np.maximum([msg.binning_x, msg.binning_y], 1)     # 0: none
    width, height = (region // binning).astype(int)
    if width < 1 or height < 1:
        raise BadCameraInfo(f'its binning ({binning[0]}x{binning[1]}) leaves no pixel of {region[0]:g}x{region[1]:g}')
    if (height, width) != tuple(image_shape):
        raise BadCameraInfo(f'CameraInfo is for {width}x{height} images (roi and binning counted), '
                            f'but the image is {image_shape[1]}x{image_shape[0]}')
    # pixel centres lie at integers: u = (u_full - offset + 1/2) / binning - 1/2
    return np.array([[1 / binning[0], 0.0, (0.5 - offset[0]) / binning[0] - 0.5],
                     [0.0, 1 / binning[1], (0.5 - offset[1]) / binning[1] - 0.5],
                     [0.0, 0.0, 1.0]])


def _matrix(values: ArrayLike, name: str, shape: tuple[int, int]) -> np.ndarray:
    """An intrinsic or projection matrix from its row-major entries."""
    m = _finite(values, name)
    if m.size != shape[0] * shape[1]:
        raise BadCameraInfo(f'{name} has {m.size} entries instead of {shape[0] * shape[1]}')
    m = m.reshape(shape)
    if not m.any():
        raise BadCameraInfo(f'{name} is zero: the camera is not calibrated')
    if abs(np.linalg.det(m[:, :3] / np.abs(m[:, :3]).max(initial=1e-300))) < 1e-12:
        raise BadCameraInfo(f'{name} is singular')
    return m


def _intrinsics(m: np.ndarray) -> np.ndarray:
    """The left 3x3 of a P whose pose is known from elsewhere."""
    if np.abs(m[np.tril_indices(3, -1)]).max() > 1e-6 * np.abs(m).max():
        raise BadCameraInfo('P\'s left 3x3 holds a rotation; where the pose comes from tf it must be the intrinsics '
                            'alone, upper triangular')
    return m


def _finite(values: ArrayLike, name: str) -> np.ndarray:
    m = np.array(values, float)
    if not np.isfinite(m).all():
        raise BadCameraInfo(f'{name} has entries that are not finite')
    if np.abs(m).max(initial=0.0) > LARGEST:
        raise BadCameraInfo(f'{name} has entries beyond {LARGEST:g}')
    return m


def _distortion(msg: Any, K: np.ndarray) -> Distortion | None:
    """What `undistort` needs of the raw image with intrinsics `K`, or None where the image is a pinhole's."""
    model, D, R = msg.distortion_model, _finite(msg.d, 'D'), _finite(msg.r, 'R').reshape(3, 3)
    if not R.any():     # never filled in
        R = np.eye(3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise BadCameraInfo('R is no rotation')
    if not D.any():   # as image_geometry has it, D of zeros is a pinhole under every model; R then still turns the rays
        return None if np.allclose(R, np.eye(3), atol=1e-9) else Distortion('plumb_bob', K, np.zeros(5), R)
    if not model:
        raise BadCameraInfo(f'D is given, but no distortion model: it must be one of {", ".join(COEFFICIENTS)}')
    model = NAMES.get(model, model)
    if model not in COEFFICIENTS:
        raise BadCameraInfo(f'distortion model "{short(model)}" is not one of {", ".join(COEFFICIENTS)}')
    known = COEFFICIENTS[model]
    if D.size > known[-1] and not D[known[-1]:].any():
        D = D[:known[-1]]
    if D.size not in known:
        raise BadCameraInfo(f'{model} has {D.size} coefficients instead of {" or ".join(map(str, known))}')
    return Distortion(model, K, D, R)
