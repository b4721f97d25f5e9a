"""The harness on real topics, within a process and as a process."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Path
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from fluoro_shape_ros.geometry.curve import arc_length
from fluoro_shape_ros.sim import carm, publisher, scenes, xray
from fluoro_shape_ros.sim import main as tool
from fluoro_shape_ros.sim.publisher import FluoroSim, RosArgumentsError
from msg_adapters.cameras import camera_info_to_view
from msg_adapters.images import image_to_array
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import path_to_points

DOMAIN = str(1 + (os.getpid() + 50) % 100)      # two runs on one machine do not meet
TOPICS = {'plane_a/image_raw': Image, 'plane_b/image_raw': Image, 'plane_a/camera_info': CameraInfo,
          'plane_b/camera_info': CameraInfo, 'ground_truth/backbone': Path, 'ground_truth/tip': PointStamped}
VIEWS = carm.biplane(arm=carm.CArm(pixel_size_iso=1e-3, width=320, height=300))
LIMIT_S = 20.0


@pytest.fixture(autouse=True)
def own_domain(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', DOMAIN)


class Ears:
    """Hears all topics: topic -> {stamp in ns: message}."""

    def __init__(self, prefix=''):
        self.heard = {topic: {} for topic in TOPICS}
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node('ears', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        for topic, kind in TOPICS.items():
            self.listen(kind, prefix + topic, lambda msg, topic=topic: self.heard[topic].update({stamp_ns(msg): msg}))

    def listen(self, kind, topic, callback, reliability=ReliabilityPolicy.RELIABLE):
        self._node.create_subscription(kind, topic, callback, QoSProfile(depth=20, reliability=reliability))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def until(self, condition):
        deadline = time.monotonic() + LIMIT_S
        while not condition() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        return bool(condition())

    def complete(self):
        """Stamps for which every topic has a message."""
        return sorted(set.intersection(*(set(messages) for messages in self.heard.values())))


@pytest.fixture
def ears():
    with Ears() as ears:
        yield ears


@pytest.fixture(scope='module')
def run():
    return scenes.xray_run(1, views=VIEWS, lengths=(0.067, 0.1), exposure=xray.Exposure(depth=12))


def test_a_pair_on_demand(ears, run):
    scene = run.scene()
    with FluoroSim() as sim:
        assert ears.until(lambda: sim.wait_for_subscribers(0.05))
        assert sim.publish(scene, 1_234_567_890_123) == 1_234_567_890_123
        assert ears.until(ears.complete)
        assert sim.published == 1
    assert ears.complete() == [1_234_567_890_123]
    messages = {topic: found[1_234_567_890_123] for topic, found in ears.heard.items()}
    for k, plane in enumerate('ab'):
        image, info = messages[f'plane_{plane}/image_raw'], messages[f'plane_{plane}/camera_info']
        assert image.encoding == 'mono16'
        np.testing.assert_array_equal(image_to_array(image), scene.frame.images[k])
        np.testing.assert_allclose(camera_info_to_view(info, plane, (300, 320)).P, VIEWS[k].P, rtol=1e-12)
        assert image.header.frame_id == info.header.frame_id == f'plane_{plane}_optical'
        assert info.distortion_model == 'plumb_bob' and list(info.d) == [0.0] * 5
    path, tip = messages['ground_truth/backbone'], messages['ground_truth/tip'].point
    points = path_to_points(path)
    np.testing.assert_allclose(points[[0, -1]], scene.truth[[0, -1]], atol=1e-12)
    np.testing.assert_array_equal(points[-1], [tip.x, tip.y, tip.z])
    assert np.ptp(np.linalg.norm(np.diff(points, axis=0), axis=1)) < 2e-6
    assert len(points) == pytest.approx(arc_length(scene.truth)[-1] * 1000, abs=2)
    assert path.header.frame_id == messages['ground_truth/tip'].header.frame_id == scenes.FRAME_ID


def test_a_frame_without_truth_and_the_clock_for_a_stamp(ears, run):
    with FluoroSim(reference_frame='cell') as sim:
        assert ears.until(lambda: sim.wait_for_subscribers(0.05))
        before = time.time_ns()
        stamp = sim.publish(run.without_device())
        assert before <= stamp <= time.time_ns()
        assert ears.until(lambda: ears.heard['plane_a/image_raw'] and ears.heard['plane_b/image_raw'])
        later = sim.publish(run.scene())
        assert ears.until(ears.complete)
    assert later > stamp
    assert (list(ears.heard['ground_truth/backbone']) == list(ears.heard['ground_truth/tip'])
            == ears.complete() == [later])
    assert ears.heard['ground_truth/tip'][later].header.frame_id == 'cell'


def test_a_stream_in_the_background(ears, run):
    with FluoroSim(scenes.ping_pong([run.scene(0.0), run.scene(0.5), run.scene(1.0)]), rate=50.0) as sim:
        assert ears.until(lambda: len(ears.complete()) >= 6)
    published, stamps = sim.published, ears.complete()
    assert published >= len(stamps)
    tips = [ears.heard['ground_truth/tip'][stamp].point for stamp in stamps]
    assert len({tip.x for tip in tips}) == 3


def test_a_stream_is_paced_and_ends(run):
    """The time of five periods is a lower bound, whatever else the machine does."""
    with FluoroSim() as sim:
        start = time.monotonic()
        sim.stream([run.scene()] * 6, rate=50.0)
        assert time.monotonic() - start >= 5 / 50 - 0.025
        assert sim.published == 6


def test_what_ends_a_stream_early_is_raised(run):
    gone = threading.Event()

    def broken():
        yield run.scene()
        gone.set()
        raise ZeroDivisionError('renderer')

    with pytest.raises(ZeroDivisionError, match='renderer'), FluoroSim(broken(), rate=1000.0):
        assert gone.wait(LIMIT_S)


def test_nobody_listens():
    with FluoroSim() as sim:
        assert not sim.wait_for_subscribers(0.1)


def test_best_effort_is_what_it_offers(ears, run):
    got = []
    ears.listen(Image, 'plane_a/image_raw', got.append, ReliabilityPolicy.BEST_EFFORT)
    with FluoroSim(itertools.repeat(run.scene()), rate=50.0, reliability='best_effort'):
        assert ears.until(lambda: got and ears.heard['ground_truth/tip'])
    assert not ears.heard['plane_a/image_raw']      # the reliable subscription is incompatible




def test_ros_arguments():
    with Ears(prefix='left/') as ears:
        with FluoroSim(ros_arguments=['--ros-args', '-r', '__ns:=/left']) as sim:
            assert ears.until(lambda: sim.wait_for_subscribers(0.05))
    with pytest.raises(RosArgumentsError, match='--nonsense'):
        FluoroSim(ros_arguments=['--ros-args', '--nonsense']).__enter__()


SMALL = ['--size', '128', '128', '--pixel-size', '0.0035', '--no-anatomy', '--rate', '20', '--prerender', '2']


@pytest.fixture
def restored_signals(monkeypatch):
    """The tool sets signal handlers and the transport profile for its whole process."""
    for name in publisher.PROFILE_VARIABLES:
        monkeypatch.setenv(name, '')
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_tool_publishes_until_told_to_stop(ears, number, tmp_path):
    log = tmp_path / 'log'
    command = [sys.executable, '-m', 'fluoro_shape_ros.sim.main', *SMALL, '--moving']
    process = subprocess.Popen(command, stdout=log.open('w'), stderr=subprocess.STDOUT)
    try:
        assert ears.until(lambda: len(ears.complete()) >= 3), log.read_text()
        process.send_signal(number)
        assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
        process.wait()
    assert 'publishing xray_spline (seed 0) at 20 pairs/s' in log.read_text()
    assert 'Traceback' not in log.read_text()


def test_the_tool_ends_after_its_frames(capsys, restored_signals):
    assert tool.main([*SMALL, '--frames', '3']) == 0
    assert 'published 3 pairs' in capsys.readouterr().out


def test_the_tool_gives_up_waiting(capsys, restored_signals):
    assert tool.main([*SMALL, '--wait', '0.1']) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and 'nobody listens to all images and camera infos after 0.1 s' in error


def test_the_large_image_profile_leaves_the_users_own_alone(monkeypatch):
    for name in publisher.PROFILE_VARIABLES:
        monkeypatch.setenv(name, '')
    publisher.use_large_image_profile()
    assert all(os.environ[name].endswith('fastdds_large_images.xml') for name in publisher.PROFILE_VARIABLES)
    monkeypatch.setenv(publisher.PROFILE_VARIABLES[0], 'mine.xml')
    publisher.use_large_image_profile()
    assert os.environ[publisher.PROFILE_VARIABLES[0]] == 'mine.xml'


@pytest.mark.parametrize('wrong, reason', [
    (['--rate', '0'], 'not above zero'),
    (['--sod', '2'], 'sod is 2 m'),
    (['--contrast', '1.5'], 'contrast 1.5'),
    (['--clutter', 'cat'], 'cat'),
    (['--angle-b', '1', '0'], 'parallel'),
    (['--ros-args', '--nonsense'], '--nonsense'),
])
def test_unusable_arguments(wrong, reason, capsys, restored_signals):
    with pytest.raises(SystemExit) as end:
        tool.main([*SMALL, *wrong])
    assert end.value.code == 2
    assert reason in capsys.readouterr().err
