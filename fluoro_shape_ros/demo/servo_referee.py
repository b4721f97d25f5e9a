"""The servo demo's referee: says where the tip is to go, and keeps what the robot, the node and the controller did.
Truth does not leave it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from msg_adapters.messages import header, ros_message, stamp_ns

from ..sim.scenes import FRAME_ID
from .own_node import OwnNode


@dataclass
class Record:
    """By stamp (ns): (3,) target, true and measured tip (m), (n,) joints; and s from a pair's way out to the command
    that it caused."""

    target: dict[int, np.ndarray] = field(default_factory=dict)
    true: dict[int, np.ndarray] = field(default_factory=dict)
    measured: dict[int, np.ndarray] = field(default_factory=dict)
    joints: dict[int, np.ndarray] = field(default_factory=dict)
    delays: list[float] = field(default_factory=list)
    blackout: tuple[int, int] | None = None     # stamps

    def error(self, stamp: int) -> float:
        """m from the true tip to the target."""
        return float(np.linalg.norm(self.true[stamp] - self.target[stamp]))


class Referee(OwnNode):
    """A context manager with a ROS context of its own; `record` fills while it spins. `now` is the robot's clock."""

    NAME = 'servo_referee'

    def __init__(self):
        self.record, self.now = Record(), None
        self.masked = False     # whether the node says that it uses a mask
        self.target: np.ndarray | None = None
        self._left: dict[int, float] = {}       # when the truth of a pair was heard, just before its images

    def _connect(self) -> None:
        self._targets = self._node.create_publisher(PointStamped, 'target', 1)
        self._services = {name: self._node.create_client(Trigger, name)
                          for name in ('fluoro_shape/capture_mask', 'insert', 'blackout')}
        for kind, topic, callback in ((PointStamped, 'ground_truth/tip', self._on_truth),
                                      (PointStamped, 'tip', self._on_tip),
                                      (JointState, 'joint_states', self._on_joints),
                                      (JointState, 'joint_command', self._on_command),
                                      (DiagnosticArray, '/diagnostics', self._on_diagnostics)):
            self._node.create_subscription(kind, topic, callback, 10)

    def ready(self) -> bool:
        """Whether all that is asked of node and robot can be."""
        return all(client.service_is_ready() for client in self._services.values())

    def capture_mask(self) -> None:
        """Ask the node for a mask; `masked` tells when it has one."""
        self._services['fluoro_shape/capture_mask'].call_async(Trigger.Request())

    def insert(self) -> None:
        """Ask the robot to come into the field."""
        self._services['insert'].call_async(Trigger.Request())

    def black_out(self) -> None:
        """Ask the robot for a blackout; `record.blackout` says when, once it has answered."""
        self._services['blackout'].call_async(Trigger.Request()).add_done_callback(
            lambda done: setattr(self.record, 'blackout', tuple(map(int, done.result().message.split()))))

    def _on_truth(self, msg: PointStamped) -> None:
        self.now = stamp_ns(msg)
        self._left[self.now] = time.monotonic()
        self.record.true[self.now] = _point(msg)
        if self.target is not None:     # told with every pair, so that a controller that comes late hears it too
            self.record.target[self.now] = self.target
            out = PointStamped(header=header(ros_message, self.now, FRAME_ID))
            out.point.x, out.point.y, out.point.z = self.target.tolist()
            self._targets.publish(out)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.masked |= any(value.key == 'mask' and value.value.startswith('in use') for status in msg.status
                           for value in status.values)

    def _on_tip(self, msg: PointStamped) -> None:
        self.record.measured[stamp_ns(msg)] = _point(msg)

    def _on_joints(self, msg: JointState) -> None:
        self.record.joints[stamp_ns(msg)] = np.array(msg.position)

    def _on_command(self, msg: JointState) -> None:
        left = self._left.pop(stamp_ns(msg), None)
        if left is not None and stamp_ns(msg) in self.record.measured:      # a hold is no answer to a pair
            self.record.delays.append(time.monotonic() - left)


def _point(msg: PointStamped) -> np.ndarray:
    return np.array([msg.point.x, msg.point.y, msg.point.z])
