"""Drive the tip to the points that come on `target`. Copy this, and put the kinematics of your own robot in place of `robot`."""
import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from fluoro_shape_ros.sim.kinematics import jacobian
from fluoro_shape_ros.sim.plant import ROBOTS

GAIN, STEP, DAMPING = 0.5, 0.005, 0.002     # share of the error taken in one go, and the most of it (m); m/s


class Controller(Node):
    def __init__(self):
        super().__init__('example_controller')
        self.robot = ROBOTS[self.declare_parameter('robot', 'two_tubes').value].robot
        self.patience = 2 / self.declare_parameter('rate', 15.0).value      # s: two pair times
        self.speed = np.array([joint.speed for joint in self.robot.joints])
        self.target, self.joints, self.seen = None, {}, 0.0
        self.command = self.create_publisher(JointState, 'joint_command', 1)
        self.create_subscription(PointStamped, 'target', lambda msg: setattr(self, 'target', position(msg)), 1)
        self.create_subscription(JointState, 'joint_states', self.on_joints, 10)
        self.create_subscription(PointStamped, 'tip', self.on_tip, 1)

    def on_joints(self, msg):
        self.joints = dict([*self.joints.items()][-30:]) | {stamp(msg): np.array(msg.position)}
        if stamp(msg) - self.seen > self.patience + 1e-3:       # blind: stay where you are
            self.command.publish(JointState(header=msg.header, position=msg.position))

    def on_tip(self, msg):
        self.seen = stamp(msg)
        q = self.joints.get(self.seen)      # where the joints were when the images were taken: delay does no harm
        if q is None or self.target is None or max(self.joints) - self.seen > self.patience + 1e-3:
            return
        error = self.target - position(msg)
        error *= GAIN * min(1.0, STEP / max(np.linalg.norm(error), 1e-9))
        J = jacobian(self.robot, q) * self.speed        # damped least squares, each joint by how fast it is
        step = self.speed * (J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(3), error))
        self.command.publish(JointState(header=msg.header, position=(q + step).tolist()))


def stamp(msg):
    return msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9


def position(msg):
    return np.array([msg.point.x, msg.point.y, msg.point.z])


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(Controller())
