"""geometry:=tf offline: poses from the tf messages of a bag."""

import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('yaml')

from drawing import BASE, CALIBRATIONS, GOOD, TOLERANCE, curve
from recording import IMAGE, INFO, SECOND, main, outcomes, read, record
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.files.recorded_tf import TF_TYPE, RecordedPoses
from fluoro_shape_ros.geometry.cameras import decompose
from fluoro_shape_ros.ros.worker import NoTransform
from msg_adapters.bags import create_bag
from msg_adapters.calibration import Calibration, calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import header
from msg_adapters.shapes import path_to_points


def message(new, *transforms):
    """A TFMessage of (parent, child, stamp in ns, R of parent_from_child, t)."""
    made = []
    for parent, child, stamp, R, t in transforms:
        q = Rotation.from_matrix(R).as_quat().tolist()
        made.append(new('geometry_msgs/msg/TransformStamped', header=header(new, stamp, parent), child_frame_id=child,
                        transform=new(
                            'geometry_msgs/msg/Transform', translation=new('geometry_msgs/msg/Vector3', x=float(t[0]),
                                                                           y=float(t[1]), z=float(t[2])),
                            rotation=new('geometry_msgs/msg/Quaternion', x=q[0], y=q[1], z=q[2], w=q[3]))))
    return new(TF_TYPE, transforms=made)


@pytest.fixture
def poses():
    """A function that makes the poses of transforms, static ones first; the messages are rosbags'."""
    from rosbags.typesys import Stores, get_typestore

    from msg_adapters.messages import bag_message
    new = bag_message(get_typestore(Stores.ROS2_JAZZY))

    def make(static=(), moving=()):
        known = RecordedPoses()
        for transforms, still in ((static, True), (moving, False)):
            for transform in transforms:
                known.take(message(new, transform), still)
        known.done()
        return known
    return make


def turn(degrees):
    return Rotation.from_euler('z', degrees, degrees=True).as_matrix()


def close(found, R, t):
    return np.allclose(found[0], R) and np.allclose(found[1], t)


def test_a_static_pose_holds_at_all_times(poses):
    """The camera is 2 m along x of the reference and turned by 90 degrees about z: the reference's origin is 2 m along
    its y."""
    known = poses([('cell', 'eye', 0, turn(90), [2, 0, 0])])
    for stamp in (1, SECOND, 10**18):
        assert close(known('cell', 'eye', stamp), turn(-90), [0, 2, 0])
    assert close(known('eye', 'cell', 5), turn(90), [2, 0, 0]) and close(known('cell', 'cell', 5), np.eye(3), [0, 0, 0])


def test_between_two_poses_it_is_interpolated(poses):
    known = poses(moving=[('cell', 'eye', SECOND, turn(10), [0, 0, 1]),
                          ('cell', 'eye', 3 * SECOND, turn(50), [0, 0, 3]),
                          ('cell', 'eye', 2 * SECOND, turn(40), [0, 0, 2])])
    assert (close(known('cell', 'eye', SECOND), turn(-10), [0, 0, -1])
            and close(known('cell', 'eye', 3 * SECOND), turn(-50), [0, 0, -3]))
    assert close(known('cell', 'eye', 1_250_000_000), turn(-17.5), [0, 0, -1.25])
    for stamp in (SECOND - 1, 3 * SECOND + 1):
        with pytest.raises(NoTransform, match='eye in cell was recorded from 1.000 to 3.000 s, not at'):
            known('cell', 'eye', stamp)


def test_along_a_tree(poses):
    """table <- cell -> arm -> source: what lies above both frames does not count, even where it was not recorded at
    that time."""
    known = poses([('cell', 'table', 0, np.eye(3), [1, 0, 0]), ('/arm', '/source', 0, turn(90), [0, 0, 1])],
                  [('cell', 'arm', SECOND, turn(0), [0, 0, 0]), ('cell', 'arm', 2 * SECOND, turn(90), [0, 0, 0]),
                   ('world', 'cell', 9 * SECOND, turn(7), [5, 5, 5])])
    # at 1.5 s the arm has turned by 45 degrees, the source by 135; the table's origin is (1, 0, 0) in the cell
    assert close(known('table', 'source', 1_500_000_000), turn(-135), turn(-135) @ [1, 0, -1])
    with pytest.raises(NoTransform, match='nothing between source and elsewhere'):
        known('elsewhere', 'source', SECOND)
    with pytest.raises(NoTransform, match='no frame_id'):
        known('table', '', SECOND)


def test_what_makes_no_sense(poses):
    with pytest.raises(NoTransform, match='in a circle'):
        poses([('a', 'b', 0, np.eye(3), [0, 0, 0]), ('b', 'a', 0, np.eye(3), [0, 0, 0])])('a', 'b', 1)
    with pytest.raises(NoTransform, match='nothing between'):
        poses([('a', 'b', 0, np.eye(3), [np.nan, 0, 0]), ('a', 'a', 0, np.eye(3), [0, 0, 0])])('a', 'b', 1)


# ---- through the command line

STAMPS = [5 * SECOND + k * SECOND // 10 for k in range(3)]


def record_tf(path, planes='ab', frames='plane_{}_optical', topic=''):
    """Three pairs whose CameraInfo has the intrinsics only; plane A's pose is static, plane B's comes twice a
    second."""
    with create_bag(path) as bag:
        for p in 'ab':
            bag.declare(f'/plane_{p}/image_raw', IMAGE)
            bag.declare(f'/plane_{p}/camera_info', INFO)
        bag.declare(f'{topic}/tf', TF_TYPE)
        bag.declare(f'{topic}/tf_static', TF_TYPE)
        for p, c in zip('ab', CALIBRATIONS):
            _, R, t = decompose(c.P)
            times = [4_900_000_000] if p == 'a' else [4_900_000_000, 5_400_000_000]
            for stamp in times if p in planes else ():
                transform = 'cell', frames.format(p), stamp, R.T, -R.T @ t
                bag.write(f'{topic}/tf_static' if p == 'a' else f'{topic}/tf', message(bag.new, transform), stamp)
        for stamp in STAMPS:
            for p, pixels, c in zip('ab', GOOD, CALIBRATIONS):
                intrinsics = Calibration(c.camera_name, c.width, c.height, c.K, np.c_[c.K, np.zeros(3)], 'plumb_bob',
                                         np.zeros(5))
                bag.write(f'/plane_{p}/camera_info',
                          calibration_to_camera_info(intrinsics, stamp, frames.format(p), bag.new), stamp)
                bag.write(f'/plane_{p}/image_raw', array_to_image(pixels, stamp, frames.format(p), bag.new), stamp)
    return path


TF = ['-p', 'geometry=tf', '-p', 'reference_frame=cell', '-p', BASE]


def test_a_replay_with_poses_from_tf_is_that_with_full_matrices(tmp_path):
    record_tf(tmp_path / 'run')
    record(tmp_path / 'full', [GOOD] * 3, stamps=STAMPS)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', *TF) == 0
    assert main(tmp_path / 'full', '--out', tmp_path / 'expected', '-p', BASE) == 0
    found, expected = (read(tmp_path / path)['/backbone'] for path in ('out', 'expected'))
    assert len(found) == 3 and {m.header.frame_id for _, m in found} == {'cell'}
    for (_, a), (_, b) in zip(found, expected):
        a, b = path_to_points(a), path_to_points(b)
        assert cKDTree(curve()).query(a)[0].max() < TOLERANCE and cKDTree(b).query(a)[0].max() < 1e-4


def test_a_mask_and_the_images_copied(tmp_path):
    record_tf(tmp_path / 'run')
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', *TF, '--with-images', '--mask', '0.15') == 0
    assert {'/tf', '/tf_static'} <= set(read(tmp_path / 'out'))
    assert main(tmp_path / 'out', '--out', tmp_path / 'again', *TF) == 0      # such a bag can be replayed itself


def test_poses_that_are_not_there_are_named(tmp_path, capsys):
    record_tf(tmp_path / 'run', planes='a')
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', *TF) == 0
    assert set(outcomes(tmp_path / 'out').values()) == {'no_transform'}
    assert 'nothing between plane_b_optical and cell' in capsys.readouterr().out


def test_tf_under_another_name(tmp_path):
    record_tf(tmp_path / 'run', topic='/robot')
    rules = ['-r', 'tf:=/robot/tf', '-r', 'tf_static:=/robot/tf_static']
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', *TF, *rules) == 0
    assert set(outcomes(tmp_path / 'out').values()) == {'ok'}


def test_a_bag_without_tf_is_said(tmp_path, capsys):
    record(tmp_path / 'full', [GOOD])
    with pytest.raises(SystemExit, match='2'):
        main(tmp_path / 'full', '--out', tmp_path / 'out', *TF)
    assert 'geometry: tf needs /tf and /tf_static, of which none is in the bag' in capsys.readouterr().err
