"""Poses of the planes from tf2, which is imported only here and only when `geometry` is `tf`."""

from __future__ import annotations

import importlib

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from .worker import NoTransform

PATIENCE_S = 0.1    # for a pose that is published a little later than the image it belongs to


class TfMissing(ImportError):
    """tf2_ros is not installed; the message says so in one line."""


def import_tf():
    """The module tf2_ros; raises TfMissing."""
    try:
        return importlib.import_module('tf2_ros')
    except ImportError as error:
        raise TfMissing(f'geometry: tf needs tf2_ros, which is not installed here ({error}); '
                        'it comes with ROS 2 (package tf2_ros_py), not from PyPI') from error


class TfPoses:
    """What tf tells `node` of poses: a Lookup, (reference frame, camera frame, stamp_ns) -> camera_from_reference as R,
    t in nested tuples.

    It waits up to PATIENCE_S for a pose to come, so it may not be called from the node's own executor, and raises
    NoTransform. Making it raises TfMissing.
    """

    def __init__(self, node: Node):
        self._tf2_ros = import_tf()
        self._buffer = self._tf2_ros.Buffer()
        self._listener = self._tf2_ros.TransformListener(self._buffer, node)

    def __call__(self, reference: str, camera: str, stamp_ns: int) -> tuple:
        if not camera:
            raise NoTransform('CameraInfo has no frame_id to look up')
        try:
            t = self._buffer.lookup_transform(camera, reference, Time(nanoseconds=stamp_ns),
                                              Duration(seconds=PATIENCE_S)).transform
        except self._tf2_ros.TransformException as error:
            raise NoTransform(f'{camera} from {reference}: {error}') from error
        q, p = t.rotation, t.translation
        R = Rotation.from_quat(np.array([q.x, q.y, q.z, q.w])).as_matrix()
        return tuple(map(tuple, R.tolist())), (p.x, p.y, p.z)

    def forget(self) -> None:
        """Forget poses that change with time: tf takes none that are older than what it has, as they are after a bag
        has looped."""
        self._buffer.clear()
