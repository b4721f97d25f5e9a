"""Poses of the planes from tf2, which is imported only here and only when `geometry` is `tf`."""

from __future__ import annotations

import importlib

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from .worker import Lookup, NoTransform

PATIENCE_S = 0.1    # for a pose that is published a little later than the image it belongs to


class TfMissing(ImportError):
    """tf2_ros is not installed; the message says so in one line."""


def import_tf():
    """The module tf2_ros; raises TfMissing."""
    try:
        return importlib.import_module('tf2_ros')
    except ImportError as error:
        raise TfMissing(f'geometry: tf needs tf2_ros, which is not installed here ({error}); it comes with ROS 2 (package tf2_ros_py), not from PyPI') from error


def transform_lookup(node: Node) -> Lookup:
    """A function (reference frame, camera frame, stamp_ns) -> camera_from_reference as R, t in nested tuples, from what tf tells `node`.

    It waits up to PATIENCE_S for a pose to come, so it may not be called from the node's own executor, and raises NoTransform. Raises TfMissing.
    """
    tf2_ros = import_tf()
    buffer = tf2_ros.Buffer()
    buffer.listener = tf2_ros.TransformListener(buffer, node)   # lives as long as the buffer

    def lookup(reference: str, camera: str, stamp_ns: int):
        if not camera:
            raise NoTransform('CameraInfo has no frame_id to look up')
        try:
            t = buffer.lookup_transform(camera, reference, Time(nanoseconds=stamp_ns), Duration(seconds=PATIENCE_S)).transform
        except tf2_ros.TransformException as error:
            raise NoTransform(f'{camera} from {reference}: {error}') from error
        q, p = t.rotation, t.translation
        R = Rotation.from_quat(np.array([q.x, q.y, q.z, q.w])).as_matrix()
        return tuple(map(tuple, R.tolist())), (p.x, p.y, p.z)
    return lookup
