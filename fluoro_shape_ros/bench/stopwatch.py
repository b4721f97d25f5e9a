"""The other end of the node's topics, with a clock: publishes pairs rendered beforehand, hears backbones and
diagnostics, calls services."""

from __future__ import annotations

import itertools
import struct
import time
from collections.abc import Callable, Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import header, ros_message

from ..data import Outcome
from ..demo.own_node import OwnNode
from ..sim.publisher import PLANES, calibration, optical_frame
from ..sim.scenes import Scene, ping_pong

IMAGE_DEPTH = 5
CALL_EVERY_S = 0.25
ON_DEMAND = {'backbone_points': PointCloud2, 'markers': MarkerArray, 'plane_a/overlay': Image, 'plane_b/overlay': Image}


class Probe(OwnNode):
    """A context manager with a ROS context of its own, used by one thread: what comes is heard while it spins or
    streams.

    `scenes` are played forth and back. Times are those of time.monotonic().
    """

    NAME = 'fluoro_shape_probe'

    def __init__(self, scenes: Sequence[Scene]):
        self.sent: dict[int, float] = {}            # stamp_ns to when the second image was handed to the middleware
        self.answered: dict[int, float] = {}        # stamp_ns to when its Path was here
        self.tip_errors: dict[int, float] = {}      # stamp_ns to m
        self.calls: list[float] = []                # s that services took to answer
        self.reports: list[tuple[float, dict[str, int]]] = []   # when diagnostics came, and what the node had counted
        self._scenes = scenes

    def _connect(self) -> None:
        node = self._node
        images = QoSProfile(depth=IMAGE_DEPTH)
        self._images = [node.create_publisher(Image, f'plane_{p}/image_raw', images) for p in PLANES]
        self._infos = [node.create_publisher(CameraInfo, f'plane_{p}/camera_info', images) for p in PLANES]
        node.create_subscription(Path, 'backbone', self._on_backbone, 10, raw=True)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        self._services = [(node.create_client(Trigger, 'fluoro_shape/clear_mask'), Trigger.Request()),
                          (node.create_client(SetParameters, 'fluoro_shape/set_parameters'),
                           SetParameters.Request(parameters=[Parameter('max_curvature',
                                                                       value=0.0).to_parameter_msg()]))]
        self._next_call = itertools.cycle(self._services)
        self._pairs = ping_pong([(scene, self._messages(scene)) for scene in self._scenes])
        self._tips: dict[int, np.ndarray] = {}      # of what is under way

    def listen_to_everything(self) -> None:
        """Subscribe to what the node computes on demand; what comes is not even deserialised."""
        for topic, kind in ON_DEMAND.items():
            self._node.create_subscription(kind, topic, lambda _: None, 1, raw=True)

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Whether `condition()` came true within `seconds`."""
        deadline = time.monotonic() + seconds
        while not condition():
            if (left := deadline - time.monotonic()) <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.05))
        return True

    def connected(self) -> bool:
        """Whether the node hears us; its services may come later."""
        return all(p.get_subscription_count() for p in (*self._images, *self._infos))

    def publish(self) -> int:
        """Send the next pair; its stamp, ns."""
        scene, (infos, images) = next(self._pairs)
        stamp = time.time_ns()
        now = header(ros_message, stamp, '').stamp
        for message in (*infos, *images):
            message.header.stamp = now
        for publisher, message in zip((*self._infos, self._images[0]), (*infos, images[0])):
            publisher.publish(message)
        self._tips[stamp] = scene.truth[-1]
        self.sent[stamp] = time.monotonic()
        self._images[1].publish(images[1])
        return stamp

    def stream(self, rate: float, seconds: float, calls: bool = False,
               stop: Callable[[], bool] = lambda: False) -> None:
        """Publish `rate` pairs a second for so many seconds or until `stop()`, and hear what comes; with `calls` ask a
        service now and then."""
        start = due = time.monotonic()
        call = start + CALL_EVERY_S
        while due < start + seconds and not stop():
            self.publish()
            # one late pair may be caught up with, a burst may not
            due = max(due + 1 / rate, time.monotonic() - 1 / rate)
            if calls and time.monotonic() > call:
                call += CALL_EVERY_S
                self._call()
            while (left := due - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=left)
            self._executor.spin_once(timeout_sec=0)

    def counts(self) -> dict[str, int]:
        """What the node has counted by now, all told; empty where it says nothing any more."""
        before = len(self.reports)
        return self.reports[-1][1] if self.until(lambda: len(self.reports) >= before + 2, 10.0) else {}

    def _call(self) -> None:
        client, request = next(self._next_call)
        if client.service_is_ready():
            start = time.monotonic()
            client.call_async(request).add_done_callback(lambda _: self.calls.append(time.monotonic() - start))

    def _messages(self, scene: Scene) -> tuple[list[CameraInfo], list[Image]]:
        frame = scene.frame
        return ([calibration_to_camera_info(calibration(view), 0, optical_frame(plane), ros_message)
                 for plane, view in zip(PLANES, frame.views)],
                [array_to_image(image, 0, optical_frame(plane), ros_message)
                 for plane, image in zip(PLANES, frame.images)])

    def _on_backbone(self, cdr: bytes) -> None:
        """A Path as it comes: to make Python objects of it takes rclpy longer than all the rest of its way."""
        now, (seconds, ns) = time.monotonic(), struct.unpack_from('<iI', cdr, 4)  # after the encapsulation's four bytes
        stamp = seconds * 10**9 + ns
        self.answered[stamp] = now
        if stamp in self._tips:
            tip = struct.unpack_from('<3d', cdr, len(cdr) - 7 * 8)      # position of the last pose
            self.tip_errors[stamp] = float(np.linalg.norm(self._tips.pop(stamp) - tip))
            for older in [s for s in self._tips if s < stamp]:
                del self._tips[older]

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        values = {status.name.rpartition(': ')[2]: {item.key: item.value for item in status.values}
                  for status in msg.status}
        if {'pairing', 'reconstruction'} <= set(values):
            outcomes = {key.removeprefix('count '): int(value) for key, value in values['reconstruction'].items()
                        if key.startswith('count ')}
            refused = sum(count for name, count in outcomes.items() if name != Outcome.OK.value)
            self.reports.append((time.monotonic(), {'dropped': int(values['pairing']['dropped']), 'refused': refused}))
