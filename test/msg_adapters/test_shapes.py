"""The backbone as messages: orientations, covariance and cloud, against answers derived by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.data import Shape
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import (
    ANY_ANGLE_VARIANCE,
    MAX_POSES,
    UNKNOWN_VARIANCE,
    BadPath,
    orientations,
    path_to_points,
    shape_to_cloud,
    shape_to_path,
    shape_to_path_cdr,
    shape_to_tip,
    shape_to_tip_pose,
    tangents,
    tip_covariance,
)

STAMP, FRAME = 7_000_000_123, 'cell'


def shape(points, s=None, variance=np.nan, residuals=0.0):
    points = np.asarray(points, float)
    if s is None:
        s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    return Shape(points, s, np.tile(np.eye(3) * variance, (len(points), 1, 1)), np.full((len(points), 2), residuals))


def straight(direction, n=30):
    d = np.asarray(direction, float)
    return shape(np.arange(n)[:, None] * 0.001 * d / np.linalg.norm(d))


def arc(radius=0.05, angle=np.pi / 2, n=80):
    """In the x-y plane, starting along +x and turning towards +y."""
    a = np.linspace(0, angle, n)
    return shape(radius * np.c_[np.sin(a), 1 - np.cos(a), 0 * a], radius * a)


def helix(n=300):
    a = np.linspace(0, 4 * np.pi, n)
    return shape(np.c_[0.02 * np.cos(a), 0.02 * np.sin(a), 0.01 * a], np.hypot(0.02, 0.01) * a)


def axes(shape):
    """(N, 3, 3) the frames, their x, y, z axes in columns."""
    return Rotation.from_quat(orientations(shape)).as_matrix()


@pytest.mark.parametrize('case', [arc(), helix(), straight([1, -2, 3])], ids=['arc', 'helix', 'straight'])
def test_x_runs_along_the_tangent_towards_the_tip(case):
    x = axes(case)[:, :, 0]
    assert_allclose(x, tangents(case), atol=1e-12)
    assert ((x[:-1] * np.diff(case.points, axis=0)).sum(axis=1) > 0).all()


def test_quaternions_of_an_arc_by_hand():
    """Tangents in the x-y plane turn about z alone: q = (0, 0, sin a/2, cos a/2), and z stays up: no roll."""
    q, a = orientations(arc()), np.linspace(0, np.pi / 2, 80)
    assert_allclose(q, np.c_[0 * a, 0 * a, np.sin(a / 2), np.cos(a / 2)], atol=1e-4)
    assert_allclose(axes(arc())[:, :, 2], np.tile([0, 0, 1.0], (80, 1)), atol=1e-12)


@pytest.mark.parametrize('direction, expected', [
    ([1, 0, 0], [0, 0, 0, 1]),
    ([0, 1, 0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]),        # a quarter turn about +z
    ([0, 0, 1], [0, -np.sqrt(0.5), 0, np.sqrt(0.5)]),       # about -y
])
def test_a_straight_backbone_takes_the_smallest_rotation(direction, expected):
    assert_allclose(orientations(straight(direction)), np.tile(expected, (30, 1)), atol=1e-12)


def test_backwards_along_x_is_half_a_turn():
    frames = axes(straight([-1, 0, 0]))
    assert_allclose(frames[:, :, 0], np.tile([-1.0, 0, 0], (30, 1)), atol=1e-12)
    assert_allclose(np.linalg.det(frames), 1.0)


def test_the_frame_never_turns_about_the_backbone():
    """Rotation-minimising: the angular velocity has no component along the tangent, also where curvature comes with
    torsion."""
    turns = Rotation.from_quat(orientations(helix()))
    step = (turns[1:] * turns[:-1].inv()).as_rotvec()
    middle = tangents(helix())[:-1] + tangents(helix())[1:]
    about = (step * middle).sum(axis=1) / np.linalg.norm(middle, axis=1)
    assert np.abs(step).max() > 0.01
    assert np.abs(about).max() < 1e-12


def test_doubling_agrees_with_one_by_one():
    """The definition: each frame is the one before, turned by the smallest rotation from tangent to tangent."""
    t, frame = tangents(helix()), np.eye(3)
    for before, after, got in zip(np.vstack([[1.0, 0, 0], t[:-1]]), t, axes(helix())):
        axis = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(axis), before @ after)
        frame = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix() @ frame
        assert_allclose(got, frame, atol=1e-9)


def test_tangents_of_uneven_steps():
    a = np.array([0, 0.1, 0.15, 0.3, 0.5])
    assert_allclose(tangents(shape(np.c_[np.cos(a), np.sin(a), 0 * a], a)), np.c_[-np.sin(a), np.cos(a), 0 * a],
                    atol=0.02)


@pytest.mark.parametrize('n', [1, 2, 3])
def test_the_shortest_shapes(n):
    assert_allclose(axes(straight([0, 1, 0], n))[:, :, 0], np.tile([1.0, 0, 0] if n == 1 else [0, 1.0, 0], (n, 1)),
                    atol=1e-12)


def test_path(new):
    case = arc()
    msg = shape_to_path(case, STAMP, FRAME, new)
    assert (stamp_ns(msg), msg.header.frame_id, len(msg.poses)) == (STAMP, FRAME, 80)
    assert {(stamp_ns(p), p.header.frame_id) for p in msg.poses} == {(STAMP, FRAME)}
    assert_allclose([[p.pose.orientation.x, p.pose.orientation.y, p.pose.orientation.z, p.pose.orientation.w]
                     for p in msg.poses], orientations(case))
    assert_allclose(path_to_points(msg), case.points)


def test_tip_is_the_last_pose(new):
    path, tip, pose = (adapter(arc(), STAMP, FRAME, new)
                       for adapter in (shape_to_path, shape_to_tip, shape_to_tip_pose))
    last = path.poses[-1].pose
    assert ([tip.point.x, tip.point.y, tip.point.z] == [last.position.x, last.position.y, last.position.z]
            == arc().tip.tolist())
    assert pose.pose.pose.position.x == last.position.x and pose.pose.pose.orientation.z == last.orientation.z
    assert stamp_ns(tip) == stamp_ns(pose) == STAMP
    assert tip.header.frame_id == pose.header.frame_id == FRAME
    assert np.array_equal(np.reshape(pose.pose.covariance, (6, 6)), tip_covariance(arc()))


def test_covariance_of_a_tip_that_points_along_z():
    # sigma 0.1 mm at both ends of a 10 mm chord: 2 (s^2 + s^2) / L^2 = 4e-4 rad^2 about x and y;
    # about z nothing is known
    points = np.arange(41)[:, None] * 0.001 * [0, 0, 1.0]
    expected = np.diag([1e-8, 1e-8, 1e-8, 4e-4, 4e-4, ANY_ANGLE_VARIANCE])
    assert_allclose(tip_covariance(shape(points, variance=1e-8)), expected, atol=1e-15)


def test_covariance_turns_the_right_way():
    """A tip along x that is uncertain in z swings about y."""
    case = straight([1, 0, 0], 11)
    case = Shape(case.points, case.s, np.tile(np.diag([0, 0, 1e-8]), (11, 1, 1)), case.residuals_px)
    assert_allclose(tip_covariance(case), np.diag([0, 0, 1e-8, ANY_ANGLE_VARIANCE, 4e-4, 0]), atol=1e-15)


def test_an_unknown_covariance_is_finite_and_large():
    assert_allclose(tip_covariance(arc()), np.diag([UNKNOWN_VARIANCE] * 3 + [ANY_ANGLE_VARIANCE] * 3))


def test_cloud(new):
    case = arc(n=5)
    covariance = np.tile(np.diag([1e-8, 4e-8, 9e-8]), (5, 1, 1))
    covariance[1] = np.nan
    residuals = np.arange(10.0).reshape(5, 2)
    msg = shape_to_cloud(Shape(case.points, case.s, covariance, residuals), 0.998, STAMP, FRAME, new)
    assert (stamp_ns(msg), msg.header.frame_id, msg.height, msg.width, msg.row_step) == (STAMP, FRAME, 1, 5,
                                                                                         5 * msg.point_step)
    assert {f.datatype for f in msg.fields} == {7} and {f.count for f in msg.fields} == {1}
    layout = np.dtype({'names': [f.name for f in msg.fields],
                       'formats': ['>f4' if msg.is_bigendian else '<f4'] * len(msg.fields),
                       'offsets': [f.offset for f in msg.fields], 'itemsize': msg.point_step})
    cloud = np.frombuffer(msg.data, layout)
    assert list(cloud.dtype.names) == ['x', 'y', 'z', 's', 'sigma', 'residual_a_px', 'residual_b_px', 'confidence']
    assert_allclose(np.c_[cloud['x'], cloud['y'], cloud['z']], case.points, rtol=1e-6, atol=1e-9)
    assert_allclose(cloud['s'], case.s, rtol=1e-6)
    assert_allclose(cloud['sigma'], [3e-4, np.nan, 3e-4, 3e-4, 3e-4], rtol=1e-6)
    assert_allclose(np.c_[cloud['residual_a_px'], cloud['residual_b_px']], residuals)
    assert cloud['confidence'].tolist() == [np.float32(0.998)] * 5
    assert not msg.is_dense


@pytest.mark.parametrize('confidence, dense', [(0.998, True), (float('nan'), False)])
def test_a_cloud_is_dense_where_all_is_known(new, confidence, dense):
    msg = shape_to_cloud(shape(arc(n=5).points, variance=1e-8), confidence, STAMP, FRAME, new)
    last = np.frombuffer(msg.data, '>f4' if msg.is_bigendian else '<f4').reshape(5, -1)[:, -1]
    assert msg.is_dense == dense and np.array_equal(last, np.full(5, confidence, np.float32), equal_nan=True)


def path(new, points):
    poses = [new('geometry_msgs/msg/PoseStamped',
                 pose=new('geometry_msgs/msg/Pose', position=new('geometry_msgs/msg/Point', x=x, y=y, z=z)))
             for x, y, z in points]
    return new('nav_msgs/msg/Path', poses=poses)


def test_points_of_a_path(new):
    assert path_to_points(path(new, [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)])).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize('points, says', [
    ([], '0 poses'),
    ([(0.0, 0.0, 0.0)], '1 poses'),
    ([(0.0, 0.0, 0.0), (0.0, float('nan'), 0.0), (float('inf'), 0.0, 0.0)],
     '2 of 3 positions are not finite, the first is pose 1'),
])
def test_a_bad_path_is_named(new, points, says):
    with pytest.raises(BadPath, match=says):
        path_to_points(path(new, points))


def test_an_endless_path_is_refused(new):
    msg = path(new, [(0.0, 0.0, 0.0)])
    msg.poses = list(msg.poses) * (MAX_POSES + 1)
    with pytest.raises(BadPath, match=f'{MAX_POSES + 1} poses'):
        path_to_points(msg)


# all alignments
@pytest.mark.parametrize('frame_id', ['', 'cell', 'plane_a', 'isocenter', 'plane_a_optical', 'r\u00f6ntgen'])
@pytest.mark.parametrize('n', [1, 2, 30])
def test_a_path_is_serialised_as_ros_does_it(frame_id, n):
    serialization = pytest.importorskip('rclpy.serialization')
    from msg_adapters.messages import ros_message
    case = straight([1, -2, 3], n)
    expected = shape_to_path(case, STAMP, frame_id, ros_message)
    got = shape_to_path_cdr(case, STAMP, frame_id)
    assert serialization.deserialize_message(got, type(expected)) == expected
    assert len(got) == len(serialization.serialize_message(expected))       # padding may hold anything
