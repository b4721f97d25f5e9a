"""Drives the tip to what comes on `target`. Copy this, and put the kinematics of your own robot in place of `robot`."""
from collections import deque

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from fluoro_shape_ros.sim.kinematics import jacobian
from fluoro_shape_ros.sim.plant import ROBOTS


class Controller(Node):
    def __init__(self):
        super().__init__('example_controller')
        self.robot = ROBOTS[self.declare_parameter('robot', 'two_tubes').value].robot
        self.patience = 2.1 / self.declare_parameter('rate', 15.0).value    # s: two pair times
        # m: a tip that is less certain than this does not count
        self.max_sigma = self.declare_parameter('max_sigma', 0.001).value
        # by which the model misjudges a motion ...
        self.model_error = self.declare_parameter('model_error', 0.3).value
        # ... and m, by which the tip may be pushed from pair to pair
        self.drift = self.declare_parameter('drift', 0.00005).value
        self.names = [joint.name for joint in self.robot.joints]
        self.speed = np.array([joint.speed for joint in self.robot.joints])
        # states: 1 s of them, if they come 1000 times a second
        self.target, self.states, self.seen = None, deque(maxlen=1000), 0.0
        # the model's tip, what the true one is beside it, its covariance
        self.model, self.offset, self.P = np.zeros(3), np.zeros(3), np.eye(3)
        self.command = self.create_publisher(JointState, 'joint_command', 1)
        for kind, topic in ((JointState, 'joint_states'), (PointStamped, 'target'),
                            (PoseWithCovarianceStamped, 'tip_pose')):
            self.create_subscription(kind, topic, getattr(self, f'on_{topic}'), 5)

    def on_joint_states(self, msg):
        named = dict(zip(msg.name, msg.position))       # in any order, and there may be others
        if not named.keys() >= set(self.names):
            return
        now, q = time_of(msg), [named[name] for name in self.names]
        if self.states and now < self.states[-1][0]:    # the clock was set back: begin anew
            self.states.clear()
            self.seen = 0.0
        self.states.append((now, q))
        if now - self.seen > self.patience:     # blind: stay where you are, and begin to measure anew
            self.P = np.eye(3)
            self.send(msg.header, q)

    def on_target(self, msg):
        self.target = np.array([msg.point.x, msg.point.y, msg.point.z])

    def on_tip_pose(self, msg):
        covariance = np.reshape(msg.pose.covariance, (6, 6))[:3, :3]
        q = self.joints_at(time_of(msg))   # where the joints were when the images were taken: then a delay does no harm
        late = q is None or self.states[-1][0] - time_of(msg) > self.patience
        if late or np.linalg.eigvalsh(covariance)[-1] > self.max_sigma**2:      # as if it had not come
            return
        self.seen = time_of(msg)
        # a Kalman filter: what the images say of the tip counts by their covariance, against what the model says it did
        # since the last pair
        tip, model = msg.pose.pose.position, self.robot.backbone(q)[-1]
        P = self.P + ((self.model_error * np.linalg.norm(model - self.model))**2 + self.drift**2) * np.eye(3)
        K = P @ np.linalg.inv(P + covariance)
        self.model, self.offset, self.P = (model, self.offset + K @ ([tip.x, tip.y, tip.z] - model - self.offset),
                                           P - K @ P)
        if self.target is None:
            return
        error = self.target - model - self.offset
        # a third of it in one go, but no more than 3 mm
        error *= min(0.35, 0.003 / max(np.linalg.norm(error), 1e-9))
        # damped least squares; faster joints do more
        J = jacobian(self.robot, q) * self.speed
        step = self.speed * (J.T @ np.linalg.solve(J @ J.T + 0.002**2 * np.eye(3), error))
        self.send(msg.header, (q + step).tolist())

    def joints_at(self, time):
        """(n,) between the two joint states around a time; None where there are none around it."""
        if not self.states or not self.states[0][0] <= time <= self.states[-1][0]:
            return None
        times, joints = zip(*self.states)
        return np.array([np.interp(time, times, values) for values in zip(*joints)])

    def send(self, header, joints):
        self.command.publish(JointState(header=header, name=self.names, position=joints))


def time_of(msg):
    return msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(Controller())
