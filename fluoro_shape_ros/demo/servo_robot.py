"""The servo demo's robot, a process: driven by `joint_command`, it tells its joints and its model's prediction, and an
X-ray system shows it."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time

import numpy as np
from nav_msgs.msg import Path
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from msg_adapters.messages import header, ros_message, stamp_ns
from msg_adapters.shapes import shape_to_path

from .. import cli
from ..data import Frame
from ..device import load_device
from ..sim import ct, imaging, plant
from ..sim.kinematics import driven
from ..sim.publisher import FluoroSim, true_shape, use_large_image_profile
from ..sim.scenes import FRAME_ID, Scene
from .own_node import OwnNode

CONNECT_S = 120.0       # for everybody to find each other
PATIENCE_S = 2.0        # for the answer to a pair, by the wall's clock
BLACKOUT_S = 1.0        # of a blackout, by the robot's clock
BLIND = 1               # the plane that a blackout takes the device from


class Robot(OwnNode):
    """Joints and X-ray system with a clock of their own, as a context manager.

    The clock goes on by a pair time a pair: as fast as the wall's, but no pair goes out before the one before the last
    has been answered. So a machine that is too slow slows the robot down, and does not decide how well it is
    controlled. At first it is not in the field, until the service `insert` is called. The service `blackout` takes the
    device from a plane for BLACKOUT_S; its message are the stamps (ns) between which.
    """

    NAME = 'servo_robot'

    def __init__(self, name: str, rate: float, what: plant.Plant):
        self._name, self._period, self._plant = name, 1 / rate, what
        self._names = [joint.name for joint in plant.ROBOTS[name].robot.joints]
        self._joints = self._command = plant.ROBOTS[name].start
        self._index, self._answered, self._stamps, self._dark = 0, 0, [time.time_ns()], (0, 0)
        self._inserted = False

    def _connect(self) -> None:
        self._states = self._node.create_publisher(JointState, 'joint_states', 10)
        self._predictions = self._node.create_publisher(Path, 'predicted_backbone', 10)
        self._node.create_subscription(JointState, 'joint_command', self._on_command, 1)
        # they come for every pair, rejected or not
        self._node.create_subscription(MarkerArray, 'markers', self._on_markers, 10)
        self._node.create_service(Trigger, 'blackout', self._on_blackout)
        self._node.create_service(Trigger, 'insert', self._on_insert)

    def run(self, xray: FluoroSim, stop: threading.Event) -> None:
        """Publish joints, prediction and a pair again and again until `stop` is set."""
        due = time.monotonic()
        while not stop.is_set():
            self._publish(xray)
            due = max(due + self._period, time.monotonic() - self._period)
            self._serve(due, stop)
            self._joints = driven(plant.ROBOTS[self._name].robot.joints, self._joints, self._command, self._period)
            self._index += 1
            self._stamps = [*self._stamps[-2:], self._stamps[-1] + round(self._period * 1e9)]

    def _publish(self, xray: FluoroSim) -> None:
        now = self._stamps[-1]
        self._states.publish(JointState(header=header(ros_message, now, ''), name=self._names,
                                        position=self._joints.tolist()))
        if self._inserted:
            model = true_shape(plant.predicted(self._name, self._joints))
            self._predictions.publish(shape_to_path(model, now, FRAME_ID, ros_message))
        xray.publish(self._scene(now), now)

    def _scene(self, now: int) -> Scene | Frame:
        if not self._inserted:
            return self._plant.run.without_device(self._index)
        scene = self._plant.scene(self._joints, self._index, now)
        return (plant.without_device(self._plant, self._index, scene, BLIND)
                if self._dark[0] <= now < self._dark[1] else scene)

    def _serve(self, due: float, stop: threading.Event) -> None:
        """Take commands until the next pair is due and the one before the last answered, the latter for at most
        PATIENCE_S."""
        late = time.monotonic() + PATIENCE_S
        waiting = lambda: self._inserted and self._answered < self._stamps[-2:][0]      # noqa: E731
        while not stop.is_set() and ((now := time.monotonic()) < due or (waiting() and now < late)):
            self._executor.spin_once(timeout_sec=max(0.0, min(due - now, 0.01)) or 0.005)

    def _on_command(self, msg: JointState) -> None:
        named = dict(zip(msg.name, msg.position))
        command = np.array([named.get(name, np.nan) for name in self._names])
        if np.isfinite(command).all():
            self._command = command

    def _on_markers(self, msg: MarkerArray) -> None:
        self._answered = max(self._answered, stamp_ns(msg.markers[0]))

    def _on_insert(self, request, response):
        self._inserted = response.success = True
        return response

    def _on_blackout(self, request, response):
        start = self._stamps[-1] + round(self._period * 1e9)
        self._dark = start, start + round(BLACKOUT_S * 1e9)
        response.success, response.message = True, '{} {}'.format(*self._dark)
        return response


def shown(args, seed: int) -> plant.Plant:
    """The robot of a seed before the X-ray system that the command line asks for. Raises ToolError where there is
    none."""
    device, volume = load_device(args.device) if args.device else None, ct.load_ct(args.ct) if args.ct else None
    try:
        return plant.plant(args.robot, seed, args.size, not args.no_anatomy, device=device, volume=volume,
                           chain=imaging.SETTINGS[args.imaging])
    except ct.CtError as error:
        raise cli.ToolError(str(error)) from error


def main(argv=None) -> int:
    """Be a robot until the process is told to end."""
    own = argparse.ArgumentParser('servo_robot', description='The robot of fluoro_shape_servo_demo.')
    own.add_argument('--robot', choices=tuple(plant.ROBOTS), required=True)
    own.add_argument('--no-anatomy', action='store_true')
    own.add_argument('--device')
    own.add_argument('--ct')
    own.add_argument('--imaging', required=True)
    for name, kind in (('--seed', int), ('--rate', float), ('--size', int)):
        own.add_argument(name, type=kind, required=True)
    return cli.run(_run, own, argv)


def _run(args) -> int:
    use_large_image_profile()
    what = shown(args, args.seed)
    stop = threading.Event()
    with FluoroSim() as xray, Robot(args.robot, args.rate, what) as robot:
        def end(*_) -> None:
            stop.set()
            xray.stop()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)      # no exception: one within rclpy's conversions would come out as another
        if not xray.wait_for_subscribers(CONNECT_S) and not stop.is_set():
            raise cli.ToolError(f'nobody listens to the images after {CONNECT_S:g} s')
        robot.run(xray, stop)
    return 0


if __name__ == '__main__':
    sys.exit(main())
