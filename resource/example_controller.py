"""Drives the tip to what comes on `target`. Copy this, and put the kinematics of your own robot in place of `robot`."""
import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from fluoro_shape_ros.sim.kinematics import jacobian
from fluoro_shape_ros.sim.plant import ROBOTS


class Controller(Node):
    def __init__(self):
        super().__init__('example_controller')
        self.robot = ROBOTS[self.declare_parameter('robot', 'two_tubes').value].robot
        self.patience = 2.1 / self.declare_parameter('rate', 15.0).value    # s: two pair times
        self.speed = np.array([joint.speed for joint in self.robot.joints])
        self.target, self.joints, self.seen = None, {}, 0.0
        self.command = self.create_publisher(JointState, 'joint_command', 1)
        for kind, topic in ((JointState, 'joint_states'), (PointStamped, 'target'), (PointStamped, 'tip')):
            self.create_subscription(kind, topic, getattr(self, f'on_{topic}'), 5)

    def on_joint_states(self, msg):
        self.joints = dict([*self.joints.items()][-30:]) | {time_of(msg): np.array(msg.position)}
        if time_of(msg) - self.seen > self.patience:        # blind: stay where you are
            self.command.publish(JointState(header=msg.header, position=msg.position))

    def on_target(self, msg):
        self.target = np.array([msg.point.x, msg.point.y, msg.point.z])

    def on_tip(self, msg):
        self.seen = time_of(msg)
        q = self.joints.get(self.seen)      # where the joints were when the images were taken: then a delay does no harm
        if q is None or self.target is None or max(self.joints) - self.seen > self.patience:
            return
        error = self.target - [msg.point.x, msg.point.y, msg.point.z]
        error *= min(0.35, 0.003 / max(np.linalg.norm(error), 1e-9))        # a third of it in one go, but no more than 3 mm
        J = jacobian(self.robot, q) * self.speed                            # damped least squares; faster joints do more
        step = self.speed * (J.T @ np.linalg.solve(J @ J.T + 0.002**2 * np.eye(3), error))
        self.command.publish(JointState(header=msg.header, position=(q + step).tolist()))


def time_of(msg):
    return msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(Controller())
