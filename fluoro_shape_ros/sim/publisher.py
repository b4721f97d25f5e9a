"""The simulator's ROS side: publishes pairs of images, camera infos and ground truth, at a rate or one by one."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Path
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image

from msg_adapters.calibration import Calibration, calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import ros_message
from msg_adapters.shapes import shape_to_path, shape_to_tip

from ..data import Frame, Shape, View
from ..geometry.cameras import decompose
from ..geometry.curve import arc_length, at_arc_length
from ..resources import resource_path
from .scenes import Scene

PLANES = ('a', 'b')
TRUTH_SPACING = 1e-3    # m, of the poses of ground_truth/backbone
PROFILE_VARIABLES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError
RELIABILITIES = {'reliable': QoSReliabilityPolicy.RELIABLE, 'best_effort': QoSReliabilityPolicy.BEST_EFFORT}


class RosArgumentsError(ValueError):
    """Arguments after --ros-args that ROS refuses."""


class FluoroSim:
    """A simulated biplane system on real topics, as a context manager with a ROS context of its own.

    Given `scenes`, it publishes them in the background, `rate` pairs a second, until they end or the block is left;
    without, it waits for `publish` or `stream`. Images and camera infos have the QoS `reliability`; ground truth is in
    `reference_frame` (None: the scene's). Raises RosArgumentsError where `ros_arguments` (`--ros-args -r ...`) can't be
    used.
    """

    def __init__(self, scenes: Iterable[Scene] | None = None, *, rate: float = 15.0, reliability: str = 'reliable',
                 reference_frame: str | None = None, ros_arguments: Sequence[str] = ()):
        self.published = 0      # pairs
        self._scenes, self._rate = scenes, rate
        self._reliability, self._reference_frame, self._arguments = (RELIABILITIES[reliability], reference_frame,
                                                                     list(ros_arguments))
        self._stop = threading.Event()
        self._streaming: Future | None = None

    def __enter__(self) -> FluoroSim:
        self._context = Context()
        try:
            rclpy.init(args=self._arguments, context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        except (UnknownROSArgsError, RuntimeError) as error:
            # rclpy has no type of its own for arguments that it can't parse
            # without places in ROS's sources
            raise RosArgumentsError(re.sub(r',? at \S+:\d+', '', f'ROS arguments: {error}')) from error
        self._node = rclpy.create_node('fluoro_shape_sim', context=self._context, start_parameter_services=False)
        images, truth = QoSProfile(depth=5, reliability=self._reliability), QoSProfile(depth=10)
        self._images = [self._node.create_publisher(Image, f'plane_{p}/image_raw', images) for p in PLANES]
        self._infos = [self._node.create_publisher(CameraInfo, f'plane_{p}/camera_info', images) for p in PLANES]
        self._backbone = self._node.create_publisher(Path, 'ground_truth/backbone', truth)
        self._tip = self._node.create_publisher(PointStamped, 'ground_truth/tip', truth)
        if self._scenes is not None:
            self._worker = ThreadPoolExecutor(1)
            self._streaming = self._worker.submit(self.stream, self._scenes, self._rate)
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        if self._streaming is not None:
            self._worker.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()
        if self._streaming is not None:
            self._streaming.result()    # raises what ended the stream before its time

    def stream(self, scenes: Iterable[Scene], rate: float) -> None:
        """Publish `scenes`, `rate` pairs a second, until they end or `stop` is called."""
        due = time.monotonic()
        for scene in scenes:
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return
            self.publish(scene)
            # one late pair may be caught up with, a burst may not
            due = max(due + 1 / rate, time.monotonic() - 1 / rate)

    def stop(self) -> None:
        """End the stream; may be called from a signal handler."""
        self._stop.set()

    def publish(self, scene: Scene | Frame, stamp_ns: int | None = None) -> int:
        """Publish a scene, or a frame without truth, and return its stamp in ns: the one given, or the node clock's
        now."""
        frame = scene.frame if isinstance(scene, Scene) else scene
        stamp_ns = self._node.get_clock().now().nanoseconds if stamp_ns is None else stamp_ns
        # what explains the images goes first, so that it is there when they are
        for plane, view, out in zip(PLANES, frame.views, self._infos):
            out.publish(calibration_to_camera_info(calibration(view), stamp_ns, optical_frame(plane), ros_message))
        if isinstance(scene, Scene):
            shape, reference = true_shape(scene.truth), self._reference_frame or frame.frame_id
            self._backbone.publish(shape_to_path(shape, stamp_ns, reference, ros_message))
            self._tip.publish(shape_to_tip(shape, stamp_ns, reference, ros_message))
        for plane, image, out in zip(PLANES, frame.images, self._images):
            out.publish(array_to_image(image, stamp_ns, optical_frame(plane), ros_message))
        self.published += 1
        return stamp_ns

    def wait_for_subscribers(self, timeout_s: float = 10.0) -> bool:
        """Whether somebody listens to all images and camera infos within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not all(p.get_subscription_count() for p in (*self._images, *self._infos)):
            if time.monotonic() > deadline or self._stop.wait(0.02):
                return False
        return True


def optical_frame(plane: str) -> str:
    """frame_id of a plane's images and camera infos."""
    return f'plane_{plane}_optical'


def calibration(view: View) -> Calibration:
    """What a plane's CameraInfo says: no distortion, and the full projection as P."""
    return Calibration(f'plane_{view.name}', view.width, view.height, decompose(view.P)[0], view.P, 'plumb_bob',
                       np.zeros(5))


def true_shape(truth: np.ndarray) -> Shape:
    """A dense (N, 3) backbone in steps of TRUTH_SPACING, the last point the tip; known without error."""
    length = arc_length(truth)[-1]
    s = np.linspace(0.0, length, max(2, round(length / TRUTH_SPACING) + 1))
    return Shape(at_arc_length(truth, s), s, np.zeros((len(s), 3, 3)), np.zeros((len(s), 2)))


def use_large_image_profile() -> None:
    """Let Fast DDS carry megapixel images through shared memory, in this process (if it has not used ROS yet) and its
    children.

    A profile that the user has chosen stays.
    """
    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ.update({name: str(resource_path('fastdds_large_images.xml')) for name in PROFILE_VARIABLES})
