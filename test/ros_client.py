"""The node as a process, and a client that talks to it on real topics: what test_node.py stands on."""

import array
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import cv2
import drawing
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from drawing import SIZE, curve, draw
from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Path
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

STEP_NS = 66_000_000
# two runs on one machine rarely meet; TEST_DOMAIN: never
DOMAIN = int(os.environ.get('TEST_DOMAIN', 1 + 2 * (os.getpid() % 50)))
OTHER = DOMAIN + 1                  # for a second node beside the first
BASE = 'base_position:=[{:.4f},{:.4f},{:.4f}]'.format(*curve()[0])     # so that the tip is no guess
RADIUS = f'robot_radius:={drawing.RADIUS}'


def intrinsics(size=SIZE):
    """(3, 3) K of an image whose pixels are 1 mm at 0.8 m."""
    return np.array([[800.0, 0, (size - 1) / 2], [0, 800.0, (size - 1) / 2], [0, 0, 1]])


def pose(angle_deg):
    """R, t of camera_from_reference of a source 0.8 m from the origin that looks at it horizontally."""
    a = np.deg2rad(angle_deg)
    forward = np.array([np.sin(a), np.cos(a), 0.0])
    right = np.cross(forward, [0, 0, 1.0])
    return np.stack([right, np.cross(forward, right), forward]), np.array([0, 0, 0.8])


def projection(angle_deg, size=SIZE):
    """(3, 4) P at `pose`."""
    return intrinsics(size) @ np.c_[pose(angle_deg)]


def pose_at(plane, stamp_ns):
    """`pose` of plane 'a' or 'b' of a C-arm that turns by 20 degrees a second."""
    return pose(20 * stamp_ns / 1e9 + {'a': 0, 'b': 90}[plane])


VIEWS = [projection(0), projection(90)]
GOOD = [draw(P) for P in VIEWS]
BLANK = [draw(P, device=False) for P in VIEWS]


def time_msg(ns):
    return Time(sec=ns // 10**9, nanosec=ns % 10**9)


def bytes_of(data):
    out = array.array('B')
    out.frombytes(data)
    return out


def image_msg(pixels, **fields):
    """A mono8 Image; `fields` override what makes it right."""
    values = dict(height=pixels.shape[0], width=pixels.shape[1], encoding='mono8', step=pixels.shape[1],
                  data=bytes_of(pixels.tobytes()))
    return Image(**{**values, **fields})


def png_msg(pixels):
    return CompressedImage(format='mono8; png compressed ', data=bytes_of(cv2.imencode('.png', pixels)[1].tobytes()))


def info_msg(P, size=SIZE, **fields):
    """A CameraInfo with full P; `fields` override."""
    values = dict(height=size, width=size, distortion_model='plumb_bob', d=[0.0] * 5,
                  k=intrinsics(size).ravel().tolist(), r=np.eye(3).ravel().tolist(), p=P.ravel().tolist())
    return CameraInfo(**{**values, **fields})


def points(path):
    """(N, 3) m, of a Path."""
    return np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses])


class NodeProcess:
    """fluoro_shape_node in a process of its own; ends with the block."""

    def __init__(self, log, *parameters, code=None, arguments=(), domain=DOMAIN):
        start = ['-m', 'fluoro_shape_ros.node'] if code is None else ['-c', code]
        arguments = ['--ros-args', *arguments, *(word for p in parameters for word in ('-p', p))]
        self._log = log
        self.process = subprocess.Popen([sys.executable, *start, *arguments], stdout=log.open('w'),
                                        stderr=subprocess.STDOUT, env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    @property
    def log(self):
        return self._log.read_text()

    def end(self, number=signal.SIGINT):
        """The exit code after a signal."""
        self.process.send_signal(number)
        return self.process.wait(timeout=20)


class Client:
    """Publishes pairs and hears the answers; a context of its own."""

    def __init__(self, reliability=ReliabilityPolicy.RELIABLE, compressed=False, start_ns=10**12, domain=DOMAIN,
                 durability=DurabilityPolicy.VOLATILE):
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node('client', enable_rosout=False, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        qos = QoSProfile(depth=10, reliability=reliability, durability=durability)
        kind, topic, self._message = ((CompressedImage, 'image_raw/compressed', png_msg)
                                      if compressed else (Image, 'image_raw', image_msg))
        self.images = [self.node.create_publisher(kind, f'plane_{p}/{topic}', qos) for p in 'ab']
        self.infos = [self.node.create_publisher(CameraInfo, f'plane_{p}/camera_info', qos) for p in 'ab']
        self.prediction = self.node.create_publisher(Path, 'predicted_backbone', 1)
        self.paths, self.tips, self.statuses = {}, {}, []
        self.node.create_subscription(Path, 'backbone', self._keep(self.paths), 10)
        self.node.create_subscription(PointStamped, 'tip', self._keep(self.tips), 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', lambda m: self.statuses.extend(m.status), 50)
        self.now_ns = start_ns

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _keep(self, messages):
        def callback(msg):
            head = msg.markers[0].header if hasattr(msg, 'markers') else msg.header
            messages[head.stamp.sec * 10**9 + head.stamp.nanosec] = msg
        return callback

    @contextmanager
    def listening(self, topics):
        """Subscribed to `topics` (name to type) for a while: topic to the messages heard, by stamp."""
        heard = {topic: {} for topic in topics}
        subscriptions = [self.node.create_subscription(kind, topic, self._keep(heard[topic]), 10)
                         for topic, kind in topics.items()]
        try:
            assert self.until(lambda: all(self.node.count_publishers(topic) for topic in topics))
            yield heard
        finally:
            for subscription in subscriptions:
                self.node.destroy_subscription(subscription)

    def until(self, condition, limit=20.0):
        """Whether `condition()` came true before the deadline."""
        deadline = time.monotonic() + limit
        while not condition() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=min(0.05, max(deadline - time.monotonic(), 0.0)))
        return bool(condition())

    def connected(self):
        """Whether the node hears us."""
        return self.until(lambda: all(p.get_subscription_count() for p in (*self.images, *self.infos)))

    def send(self, messages, infos=None, skew_ns=0, stamp_ns=None, infos_last=False):
        """Publish a pair of image messages with camera infos (an empty list: none); the stamp of plane A."""
        if stamp_ns is None:
            self.now_ns += STEP_NS
            stamp_ns = self.now_ns
        infos = [info_msg(P) for P in VIEWS] if infos is None else infos
        for k, m in enumerate(messages):
            m.header.stamp, m.header.frame_id = time_msg(stamp_ns + k * skew_ns), f'plane_{"ab"[k]}_optical'
        for m, image in zip(infos, messages):
            m.header = image.header
        todo = [*zip(self.infos, infos), *zip(self.images, messages)]
        for publisher, m in todo[::-1] if infos_last else todo:
            publisher.publish(m)
        return stamp_ns

    def send_pixels(self, pair, **options):
        return self.send([self._message(pixels) for pixels in pair], **options)

    def answer(self, stamp_ns, limit=20.0):
        """Path and tip with this stamp, or None."""
        heard = self.until(lambda: stamp_ns in self.paths and stamp_ns in self.tips, limit)
        return (self.paths[stamp_ns], self.tips[stamp_ns]) if heard else None

    def insist(self, condition, pair=GOOD, every=0.3, **options):
        """Whether `condition()` came true while a pair was sent again and again: discovery takes its time, and
        best-effort may lose it."""
        return any(self.send_pixels(pair, **options) and self.until(condition, every) for _ in range(60))

    def good(self):
        """The answer to a good pair, sent once more where it takes long."""
        first = self.now_ns + STEP_NS
        answered = lambda: [t for t in self.paths if t in self.tips and first <= t <= self.now_ns]  # noqa: E731
        return self.answer(max(answered())) if self.insist(answered, every=1.0) else None

    def hears(self, *words):
        """Whether from now on a diagnostics message has all these words."""
        del self.statuses[:]
        return self.until(lambda: any(all(w in s.message for w in words) for s in self.statuses))

    def value(self, name, key):
        """The newest value of a key in the diagnostics of e.g. 'pairing', heard from now on."""
        del self.statuses[:]
        found = lambda: [v.value for s in self.statuses if s.name.endswith(name)    # noqa: E731
                         for v in s.values if v.key == key]
        assert self.until(found)
        return found()[-1]

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        try:
            assert client.wait_for_service(60)
            future = client.call_async(request)
            assert self.until(future.done)
            return future.result()
        finally:
            self.node.destroy_client(client)

    def trigger(self, name):
        return self.call(Trigger, f'/fluoro_shape/{name}', Trigger.Request())

    def get(self, *names, node='/fluoro_shape'):
        """The values of parameters."""
        values = self.call(GetParameters, f'{node}/get_parameters', GetParameters.Request(names=names)).values
        return [parameter_value_to_python(value) for value in values]

    def set(self, name, value=None, type_=None):
        """The result of setting a parameter."""
        msg: ParameterMsg = Parameter(name, type_, value).to_parameter_msg()
        return self.call(SetParameters, '/fluoro_shape/set_parameters',
                         SetParameters.Request(parameters=[msg])).results[0]


@contextmanager
def answered(tmp_path_factory, *parameters):
    """A NodeProcess and a Client that it has answered; when the block is left, the node must be alive and have told of
    no bug.

    It takes its time: on a busy machine some pair would be out of time.
    """
    with (NodeProcess(tmp_path_factory.mktemp('node') / 'log.txt', 'time_budget:=0', *parameters) as node,
          Client() as client):
        assert client.connected() and client.insist(lambda: client.paths), node.log
        yield node, client
        assert node.process.poll() is None, node.log
        assert 'Traceback' not in node.log, node.log
