"""geometry:=tf: the example that is installed, poses of a C-arm that moves, and what is said where tf2 is not
installed."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.geometry.cameras import decompose
from fluoro_shape_ros.resources import resource_path
from fluoro_shape_ros.ros.pairing import PLANES
from fluoro_shape_ros.ros.worker import Job, NoTransform, adapt, camera, view_of
from fluoro_shape_ros.sim import carm
from msg_adapters.calibration import calibration_to_camera_info, read_calibration
from msg_adapters.diagnostics import Tally
from msg_adapters.images import array_to_image

REFERENCE = 'isocenter'
SECOND = 10**9


def camera_from(reference_from_camera):
    """R, t the other way round, in nested tuples as a lookup gives them."""
    R, t = reference_from_camera
    return tuple(map(tuple, R.T.tolist())), tuple((-R.T @ t).tolist())


@pytest.fixture(scope='module')
def example():
    """Child frame -> R, t of reference_from_camera, as example_tf.launch.yaml has static_transform_publisher publish
    them."""
    yaml = pytest.importorskip('yaml')
    poses = {}
    for entry in yaml.safe_load(resource_path('example_tf.launch.yaml').read_text())['launch']:
        node = entry['node']
        assert (node['pkg'], node['exec']) == ('tf2_ros', 'static_transform_publisher')
        words = node['args'].split()
        given = dict(zip(words[::2], words[1::2]))
        assert given['--frame-id'] == REFERENCE
        q, t = ([float(given[f'--{name}']) for name in names] for names in (('qx', 'qy', 'qz', 'qw'), 'xyz'))
        poses[given['--child-frame-id']] = Rotation.from_quat(np.array(q)).as_matrix(), np.array(t)
    return poses


def pair(new, calibrations, stamps):
    """The job of a pair in the geometry tf."""
    frames = [f'plane_{plane}_optical' for plane in PLANES]
    cameras = tuple(camera(calibration_to_camera_info(c, 0, frame, new)) for c, frame in zip(calibrations, frames))
    images = tuple(array_to_image(np.zeros((c.height, c.width), np.uint8), stamp, frame, new)
                   for c, stamp, frame in zip(calibrations, stamps, frames))
    return Job(stamps[0], images, cameras, Config.from_values(geometry='tf', reference_frame=REFERENCE), 0, 0.0)


def test_the_example_is_the_biplane_c_arm_of_full_matrices(new, example):
    calibrations = [read_calibration(resource_path(f'example_plane_{plane}.yaml')) for plane in PLANES]
    frame = adapt(pair(new, calibrations, (5, 5)), view_of, lambda reference, child, stamp: camera_from(example[child]),
                  Tally())
    assert frame.frame_id == REFERENCE
    for view, full in zip(frame.views, carm.biplane()):
        assert (view.width, view.height, view.distortion) == (full.width, full.height, None)
        assert np.allclose(view.P, full.P, rtol=1e-8, atol=1e-5)


def turning(reference, child, stamp_ns):
    """A C-arm that turns by 10 degrees a second; both planes hang on it."""
    primary = np.deg2rad(10.0) * stamp_ns / SECOND + (0.0 if child == 'plane_a_optical' else np.pi / 2)
    _, R, t = decompose(carm.view('x', primary).P)
    return tuple(map(tuple, R.tolist())), tuple(t.tolist())


def test_each_plane_has_the_pose_of_its_own_image_on_a_c_arm_that_turns(new, example):
    calibrations = [read_calibration(resource_path(f'example_plane_{plane}.yaml')) for plane in PLANES]
    frame = adapt(pair(new, calibrations, (2 * SECOND, 3 * SECOND)), view_of, turning, Tally())
    expected = carm.view('a', np.deg2rad(20.0)), carm.view('b', np.deg2rad(90.0 + 30.0))
    for view, full in zip(frame.views, expected):
        assert np.allclose(view.P, full.P, rtol=1e-8, atol=1e-5)


def test_what_tf_does_not_know_is_named(new, example):
    def lookup(reference, child, stamp_ns):
        raise NoTransform(f'{child} from {reference}: nobody publishes it')
    calibrations = [read_calibration(resource_path(f'example_plane_{plane}.yaml')) for plane in PLANES]
    result = adapt(pair(new, calibrations, (5, 5)), view_of, lookup, Tally())
    assert result.outcome is Outcome.NO_TRANSFORM and 'plane_a_optical from isocenter' in result.detail


# ---- tf2 itself


def transform(R, t):
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return SimpleNamespace(rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
                           translation=SimpleNamespace(x=t[0], y=t[1], z=t[2]))


class StandIn:
    """What the node uses of tf2_ros, with tf's own rule: lookup_transform(target, source) takes points of the source
    frame to the target frame."""

    class TransformException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target_frame, source_frame, time, timeout):
            if target_frame != 'plane_a_optical':
                raise StandIn.TransformException(f'"{target_frame}" passed to lookupTransform argument target_frame '
                                                 'does not exist.')
            assert timeout.nanoseconds > 0
            R, t = turning(source_frame, target_frame, time.nanoseconds)
            return SimpleNamespace(transform=transform(np.array(R), t))

    def TransformListener(self, buffer, node):
        return node


def test_what_is_asked_of_tf2(monkeypatch):
    pytest.importorskip('rclpy')
    from fluoro_shape_ros.ros.transforms import TfPoses
    monkeypatch.setitem(sys.modules, 'tf2_ros', StandIn())
    lookup = TfPoses('the node')
    R, t = lookup(REFERENCE, 'plane_a_optical', 2 * SECOND)
    expected = turning(REFERENCE, 'plane_a_optical', 2 * SECOND)
    assert np.allclose(R, expected[0]) and np.allclose(t, expected[1])
    hash((R, t))    # views are cached by it
    with pytest.raises(NoTransform, match='nowhere from isocenter: "nowhere" passed'):
        lookup(REFERENCE, 'nowhere', 2 * SECOND)
    with pytest.raises(NoTransform, match='no frame_id'):
        lookup(REFERENCE, '', 2 * SECOND)


def test_a_real_buffer_interpolates_between_poses(monkeypatch):
    """Only where ROS 2 is installed with tf2."""
    tf2_ros = pytest.importorskip('tf2_ros')
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
    from std_msgs.msg import Header

    from fluoro_shape_ros.ros.transforms import TfPoses
    made = []
    monkeypatch.setattr(tf2_ros, 'TransformListener', lambda buffer, node: made.append(buffer))
    lookup = TfPoses(None)
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.2]])
    for stamp, turn, x in zip((10, 11), turns, (0.0, 0.4)):
        q = turn.as_quat()
        made[0].set_transform(TransformStamped(
            header=Header(frame_id=REFERENCE, stamp=Time(sec=stamp)), child_frame_id='plane_a_optical',
            transform=Transform(translation=Vector3(x=x, y=0.0, z=1.0),
                                rotation=Quaternion(x=q[0], y=q[1], z=q[2], w=q[3]))), 'test')
    half = Slerp([0, 1], turns)(0.5).as_matrix(), np.array([0.2, 0.0, 1.0])
    for got, expected in zip(lookup(REFERENCE, 'plane_a_optical', 10 * SECOND + SECOND // 2), camera_from(half)):
        assert np.allclose(got, expected, atol=1e-9)
    with pytest.raises(NoTransform, match='plane_a_optical from isocenter: .*extrapolation'):
        lookup(REFERENCE, 'plane_a_optical', 20 * SECOND)
    with pytest.raises(NoTransform, match='nowhere'):
        lookup(REFERENCE, 'nowhere', 10 * SECOND)
    lookup.forget()
    with pytest.raises(NoTransform):
        lookup(REFERENCE, 'plane_a_optical', 10 * SECOND)


def test_without_tf2_the_node_says_so_in_one_line():
    pytest.importorskip('rclpy')
    code = 'import sys; sys.modules["tf2_ros"] = None; from fluoro_shape_ros.node import main; sys.exit(main())'
    done = subprocess.run([sys.executable, '-c', code, '--ros-args', '-p', 'geometry:=tf'], capture_output=True,
                          text=True, timeout=60)
    assert (done.returncode == 1 and done.stderr.count('\n') == 1
            and 'needs tf2_ros, which is not installed' in done.stderr), done.stderr
