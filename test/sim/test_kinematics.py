"""Robots moved by joints, against closed forms."""

import numpy as np
import pytest

from fluoro_shape_ros.geometry.curve import arc_length, curvature
from fluoro_shape_ros.sim.kinematics import TendonRobot, Tube, TubeRobot, driven, jacobian, limited, loaded, reaching
from fluoro_shape_ros.sim.shapes import Cannula, Pose

QUARTER = np.pi / 2
OUTER, MIDDLE, INNER = Tube(6.0, 10.0, 0.06), Tube(3.0, 20.0, 0.06), Tube(1.0, 30.0, 0.06)
TWO, THREE = TubeRobot((OUTER, INNER)), TubeRobot((OUTER, MIDDLE, INNER))
TENDON = TendonRobot(0.05, 0.001)
TURNED = Pose(np.array([0.1, 0.2, 0.3]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))


def some(robot, seed=0):
    """(n,) joint values well within their limits."""
    rng = np.random.default_rng(seed)
    return np.array([rng.uniform(0.7 * j.low + 0.3 * j.high, 0.1 * j.low + 0.9 * j.high) for j in robot.joints])


def test_two_tubes_are_a_cannula_whose_first_section_balances_their_moments():
    q = np.array([0.03, 0.02, 0.0, QUARTER])     # 6 x 10 in y against 1 x 30 in z, over 7
    cannula = Cannula(0.03, np.hypot(60, 30) / 7, np.arctan2(30, 60), 0.02, 30.0, QUARTER)
    np.testing.assert_allclose(TWO.backbone(q), cannula.backbone(), atol=1e-12)


@pytest.mark.parametrize('rotation, bend', [(0.0, 90 / 7), (np.pi, 30 / 7)])
def test_tubes_turned_alike_add_up_and_turned_against_each_other_take_away(rotation, bend):
    points = TWO.backbone(np.array([0.05, 0.004, 0.0, rotation]))
    np.testing.assert_allclose(curvature(points)[:450], bend, rtol=1e-3)


def test_three_tubes_in_one_plane_by_hand():
    """Sections of 20 mm each, all tubes at the same rotation: curvatures (60 + 60 + 30) / 10, (60 + 30) / 4 and 30."""
    sections = THREE.sections(np.array([0.02, 0.02, 0.02, 0.3, 0.3, 0.3]))
    np.testing.assert_allclose([(p.length, p.curvature, p.rotation) for p in sections],
                               [(0.02, 15, 0.3), (0.02, 22.5, 0.3), (0.02, 30, 0.3)])
    turn = 0.02 * (15 + 22.5 + 30)
    tip = TubeRobot(THREE.tubes).backbone(np.array([0.02] * 3 + [0.0] * 3))[-1]
    angles = 0.02 * np.cumsum([0, 15, 22.5, 30])
    across = sum((np.array([np.sin(b) - np.sin(a), np.cos(a) - np.cos(b)])) / k
                 for a, b, k in zip(angles, angles[1:], (15, 22.5, 30)))
    assert angles[-1] == pytest.approx(turn)
    np.testing.assert_allclose(tip, [*across, 0], atol=1e-9)


def test_a_tube_is_straight_before_its_curved_part():
    """The inner tube reaches 10 mm out of the outer one, which is straight: its other 20 mm of curve lie in there."""
    robot = TubeRobot((Tube(3.0, 0.0, 0.06), Tube(1.0, 40.0, 0.03)))
    sections = robot.sections(np.array([0.05, 0.01, 0.0, 1.0]))
    np.testing.assert_allclose([(p.length, p.curvature) for p in sections], [(0.03, 0), (0.02, 10), (0.01, 40)],
                               atol=1e-12)


def test_a_tendon_segment_bends_to_an_arc():
    """Pulled by a quarter turn times the tendons' distance: the tip stands aside and ahead of the shaft by the radius
    of the arc."""
    radius = 0.05 / QUARTER
    for pull, rotation, tip in (((QUARTER * 1e-3, 0), 0, (radius, 0)), ((0, QUARTER * 1e-3), 0, (0, radius)),
                                ((QUARTER * 1e-3, 0), QUARTER, (0, radius))):
        np.testing.assert_allclose(TENDON.backbone(np.array([0.02, rotation, *pull]))[-1], [0.02 + radius, *tip],
                                   atol=1e-9)
    np.testing.assert_allclose(TENDON.backbone(np.array([0.02, 1.0, 0, 0]))[-1], [0.07, 0, 0], atol=1e-12)


@pytest.mark.parametrize('robot', [TWO, THREE, TENDON])
def test_turning_everything_turns_the_robot_and_the_pose_places_it(robot):
    q, turned = some(robot), some(robot)
    rotations = [k for k, joint in enumerate(robot.joints) if joint.name.startswith('rotation')]
    turned[rotations] += 0.7
    x, y, z = robot.backbone(q).T
    np.testing.assert_allclose(robot.backbone(turned), np.c_[x, np.cos(0.7) * y - np.sin(0.7) * z,
                                                             np.sin(0.7) * y + np.cos(0.7) * z], atol=1e-12)
    placed = type(robot)(**{**vars(robot), 'pose': TURNED})
    np.testing.assert_allclose(placed.backbone(q), np.c_[z, x, y] + [0.1, 0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize('robot', [TWO, THREE, TENDON])
def test_the_jacobian_foretells_small_steps(robot):
    q = some(robot)
    for d in np.diag([1e-3 * (joint.high - joint.low) for joint in robot.joints]):
        moved = robot.backbone(q + d)[-1] - robot.backbone(q)[-1]
        np.testing.assert_allclose(jacobian(robot, q) @ d, moved, atol=0.02 * np.linalg.norm(moved) + 1e-9)


@pytest.mark.parametrize('robot', [TWO, THREE, TENDON])
def test_a_robot_is_placed_where_its_tip_shall_be(robot):
    tip = robot.backbone(some(robot, 1))[-1]
    np.testing.assert_allclose(robot.backbone(reaching(robot, tip, some(robot)))[-1], tip, atol=1e-4)


def test_a_joint_keeps_its_speed_and_its_limits():
    q = np.array([0.02, 0.02, 0.0, 0.0])
    np.testing.assert_allclose(driven(TWO.joints, q, np.array([0.0205, 9.0, -9.0, 0.05]), 0.1),
                               [0.0205, 0.022, -0.1, 0.05])
    np.testing.assert_allclose(driven(TWO.joints, q, np.array([9.0, -9.0, 9.0, -9.0]), 1e3),
                               [0.1, 0.004, 2 * np.pi, -2 * np.pi])
    np.testing.assert_allclose(limited(TWO.joints, np.array([0.0, 1.0, 0.0, 0.0])), [0.004, 0.1, 0, 0])


def test_a_load_bends_a_straight_rod_as_a_cantilever():
    rod = np.c_[np.linspace(0, 0.1, 1001), np.zeros((1001, 2))]
    bent = loaded(rod, np.array([0.0, 6.0, 0.0]))
    x = rod[:, 0]
    # F x^2 (3 L - x) / (6 E I): 2 mm at the tip
    np.testing.assert_allclose(bent[:, 1], 6.0 * x**2 * (0.3 - x) / 6, atol=2e-6)
    assert arc_length(bent)[-1] == pytest.approx(0.1, rel=1e-9)
    np.testing.assert_allclose(loaded(rod, np.array([5.0, 0.0, 0.0])), rod, atol=1e-12)     # along the rod: no moment


@pytest.mark.parametrize('robot', [TWO, THREE, TENDON])
def test_a_misjudged_robot_ends_elsewhere(robot):
    q = some(robot)
    assert 1e-3 < np.linalg.norm(robot.misjudged(0.12).backbone(q)[-1] - robot.backbone(q)[-1]) < 0.02
    np.testing.assert_allclose(robot.misjudged(0.0).backbone(q), robot.backbone(q))
