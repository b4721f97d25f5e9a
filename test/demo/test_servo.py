"""The servo demo: its controller by hand, its bookkeeping, the robots it moves, its documentation, and one run on real
topics."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.device import REST, Device, Segment
from fluoro_shape_ros.geometry.cameras import project
from fluoro_shape_ros.resources import resource_path
from fluoro_shape_ros.sim import ct, placement, plant, variety
from fluoro_shape_ros.sim.kinematics import limited

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = 'example_controller.py'
PERIOD_NS = 66_666_667


# ---- robots


@pytest.mark.parametrize('name', plant.ROBOTS)
def test_without_the_loop_every_target_is_missed(name):
    robot = plant.ROBOTS[name].robot
    for seed in range(3):
        moved = plant.plant(name, seed, 64, with_anatomy=False)
        targets, joints = plant.goals(name, seed, moved, 2)
        for target, q in zip(targets, joints):
            assert_allclose(robot.backbone(q, plant.STEP)[-1], target, atol=0.3e-3)
            assert_allclose(limited(robot.joints, q), q)
            assert np.linalg.norm(moved.backbone(q)[-1] - target) > 3e-3


def test_a_plant_shows_its_robot_with_a_shaft_that_comes_in_through_the_border():
    moved, q = plant.plant('two_tubes', 1, 128, with_anatomy=False), plant.ROBOTS['two_tubes'].start
    scene = moved.scene(q, 0, 5)
    assert scene.frame.stamp_ns == 5 and scene.frame.images[0].shape == (128, 128)
    assert_allclose(scene.truth[-1], moved.backbone(q)[-1])
    assert scene.truth[0][2] < moved.backbone(q)[0][2] - 0.02
    blind = plant.without_device(moved, 0, scene, 1)
    assert blind.frame.images[0] is scene.frame.images[0] and blind.frame.images[1].min() > scene.frame.images[1].min()


def block(bone):
    """A cube of water of 18 cm, of which a third, on the patient's right, has `bone` Hounsfield units."""
    hu = np.full((24, 24, 24), -1000, np.int16)
    hu[1:-1, 1:-1, 1:-1] = 0
    hu[1:-1, 1:-1, 1:9] = bone
    return ct.Volume(hu, np.full(3, 0.008))


def test_a_ct_lies_where_the_robot_can_be_seen(monkeypatch):
    thick, places, in_ct = Device((Segment(REST, 0.002, 'metal'),)), [], variety.in_ct
    monkeypatch.setattr(variety, 'in_ct', lambda *drawn: places.append(drawn) or in_ct(*drawn))
    moved = plant.plant('two_tubes', 2, 128, device=thick, volume=block(3000))
    assert len(places) > 1      # behind bone it can't
    whole = placement.with_shaft(moved.backbone(plant.ROBOTS['two_tubes'].start), plant.SHAFT)
    assert variety.visible(moved.run, True, whole)
    assert_allclose(moved.load, plant.plant('two_tubes', 2, 64, with_anatomy=False).load)   # the same robot, otherwise
    monkeypatch.setattr(plant, 'PLACES', 2)
    with pytest.raises(ct.CtError, match='seed 2 can be seen in none of 2 places of the CT'):
        plant.plant('two_tubes', 2, 128, device=thick, volume=block(3000))


# ---- the example controller, without a network

rclpy = pytest.importorskip('rclpy')


@pytest.fixture
def controller():
    rclpy.init(domain_id=1 + 2 * (os.getpid() % 50))
    node = runpy.run_path(str(resource_path(EXAMPLE)))['Controller']()
    sent = []
    node.command = SimpleNamespace(publish=sent.append)
    yield node, sent
    node.destroy_node()
    rclpy.try_shutdown()


def joints(q, k):
    from sensor_msgs.msg import JointState
    names = [joint.name for joint in plant.ROBOTS['two_tubes'].robot.joints]
    return stamped(JointState(name=names, position=list(q)), k)


def turned(msg):
    """The same joints in another order, with another robot's among them."""
    msg.name, msg.position = ['gripper', *msg.name[::-1]], [0.5, *msg.position[::-1]]
    return msg


def tip_pose(xyz, k, sigmas=(1e-4, 1e-4, 1e-4)):
    from geometry_msgs.msg import PoseWithCovarianceStamped
    msg = PoseWithCovarianceStamped()
    msg.pose.pose.position.x, msg.pose.pose.position.y, msg.pose.pose.position.z = map(float, xyz)
    msg.pose.covariance = np.diag([*np.square(sigmas), 9.0, 9.0, 9.0]).ravel()
    return stamped(msg, k)


def stepped(node, sent, q, msg):
    """(3,) by how much the model's tip moves from joints `q` to what `msg` makes the controller command."""
    sent.clear()
    node.on_tip_pose(msg)
    (command,) = sent
    robot = plant.ROBOTS['two_tubes'].robot
    assert command.name == [joint.name for joint in robot.joints]
    return robot.backbone(np.array(command.position), 5e-4)[-1] - robot.backbone(q, 5e-4)[-1]


def point(xyz, k=0):
    from geometry_msgs.msg import PointStamped
    msg = PointStamped()
    msg.point.x, msg.point.y, msg.point.z = map(float, xyz)
    return stamped(msg, k)


def stamped(msg, k):
    msg.header.stamp.sec, msg.header.stamp.nanosec = 1, round(k * PERIOD_NS)
    return msg


def test_it_goes_a_third_of_the_way_from_where_the_joints_were(controller):
    node, sent = controller
    q, target = plant.ROBOTS['two_tubes'].start, np.array([1e-3, -2e-3, 1e-3])
    node.on_target(point(target))
    for k, moved in enumerate((q, q + 0.001)):
        node.on_joint_states(joints(moved, k))
    # the model is elsewhere: only the difference counts
    assert_allclose(stepped(node, sent, q, tip_pose(np.zeros(3), 0)), 0.35 * target, atol=0.15e-3)


def test_joints_go_by_name_and_are_taken_between_the_states_around_the_images(controller):
    node, sent = controller
    q, moved = plant.ROBOTS['two_tubes'].start, np.array([0.01, -0.02, 0.3, -0.5])
    node.on_target(point(np.zeros(3)))
    for k, part in ((0, 0.0), (0.5, 0.5), (1.5, 0.7)):
        node.on_joint_states(turned(joints(q + part * moved, k)))
    for k, part in ((0, 0.0), (0.25, 0.25), (0.75, 0.55), (1.5, 0.7)):
        sent.clear()
        node.on_tip_pose(tip_pose(np.zeros(3), k, (1e-7,) * 3))     # at its target: stay where the images have it
        assert_allclose(sent.pop().position, q + part * moved, atol=1e-5)
    sent.clear()
    node.on_tip_pose(tip_pose(np.zeros(3), 1.6))        # nobody knows yet where the joints were
    lacking = joints(q, 9)
    lacking.name, lacking.position = lacking.name[:3], lacking.position[:3]
    node.on_joint_states(lacking)
    assert not sent


def test_a_measured_tip_counts_by_its_covariance_against_what_the_model_knows(controller):
    node, sent = controller
    q, sigma = plant.ROBOTS['two_tubes'].start, np.array([0.5e-3, 0.1e-3, 0.02e-3])
    node.on_target(point(np.zeros(3)))
    for k, tip in ((0, np.zeros(3)), (1, np.full(3, 1e-3))):     # at rest the model says that the tip stays where it is
        node.on_joint_states(joints(q, k))
        step = stepped(node, sent, q, tip_pose(tip, k, sigma))
    believed = sigma**2 + node.drift**2         # of the first one, which nothing was known before
    assert_allclose(node.offset + node.model, 1e-3 * believed / (believed + sigma**2), rtol=1e-4)
    assert_allclose(step, -0.35 * (node.offset + node.model), atol=0.1e-3)
    # once the joints moved, the model may be wrong by a share of what it says that the tip did: of the uncertain axis
    # it is still the better witness
    robot, before, spread = plant.ROBOTS['two_tubes'].robot, node.offset, np.diag(node.P)
    moved = q + [0.003, 0, 0, 0]
    node.on_joint_states(joints(moved, 2))
    node.on_tip_pose(tip_pose(np.zeros(3), 2, sigma))
    model = robot.backbone(moved)[-1]
    spread = spread + (0.3 * np.linalg.norm(model - robot.backbone(q)[-1]))**2 + node.drift**2
    assert_allclose(node.offset, before + spread / (spread + sigma**2) * (-model - before), rtol=1e-6)


def test_a_tip_beyond_the_bound_counts_as_none_and_after_a_hold_it_is_measured_anew(controller):
    node, sent = controller
    q, target = plant.ROBOTS['two_tubes'].start, np.array([1e-3, -2e-3, 1e-3])
    node.on_target(point(target))
    node.on_joint_states(joints(q, 0))
    node.on_tip_pose(tip_pose([5e-3, 0, 0], 0, (1e-5, 1e-5, 1e-5)))
    sent.clear()
    for k in (1, 2, 3):
        node.on_joint_states(joints(q, k))
        node.on_tip_pose(tip_pose(np.zeros(3), k, (1e-4, 1.01e-3, 1e-4)))
    assert_allclose(sent.pop().position, q)     # it has not come for more than two pair times
    assert not sent
    assert_allclose(stepped(node, sent, q, tip_pose(np.zeros(3), 3, (9e-4, 9e-4, 9e-4))), 0.35 * target, atol=0.15e-3)


def test_a_clock_that_is_set_back_begins_anew(controller):
    node, sent = controller
    q = plant.ROBOTS['two_tubes'].start
    node.on_target(point(np.zeros(3)))
    node.on_joint_states(joints(q, 8))
    node.on_tip_pose(tip_pose(np.zeros(3), 8))
    sent.clear()
    node.on_joint_states(joints(q + 1, 3))
    assert_allclose(sent.pop().position, q + 1)     # the tip was seen at a time that is still to come
    node.on_tip_pose(tip_pose(np.zeros(3), 3))
    assert_allclose(sent.pop().position, q + 1)


def test_it_stays_where_it_is_once_the_tip_is_older_than_two_pair_times(controller):
    node, sent = controller
    q = plant.ROBOTS['two_tubes'].start
    node.on_target(point([0.01, 0, 0]))
    node.on_joint_states(joints(q, 0))
    node.on_tip_pose(tip_pose([0, 0, 0], 0))
    sent.clear()
    for k in (1, 2):
        node.on_joint_states(joints(q + k, k))
    assert not sent
    node.on_joint_states(joints(q + 3, 3))
    assert_allclose(sent.pop().position, q + 3)
    node.on_tip_pose(tip_pose([0, 0, 0], 0))        # too old to act on, and so is one without joints
    node.on_tip_pose(tip_pose([0, 0, 0], 9))
    assert not sent


# ---- bookkeeping


def record():
    """Ten pairs; the true tip comes 1 mm nearer each, the fourth to seventh are not measured."""
    from fluoro_shape_ros.demo.servo_referee import Record
    true = {k * PERIOD_NS: np.array([(9 - k) * 1e-3, 0.0, 0.0]) for k in range(10)}
    return Record(target={t: np.zeros(3) for t in true}, true=true,
                  measured={t: x for k, (t, x) in enumerate(true.items()) if not 4 <= k < 8},
                  joints=dict.fromkeys(true, plant.ROBOTS['two_tubes'].start), delays=[0.05])


def a_run(**changed):
    from fluoro_shape_ros.demo.servo_run import Run
    return Run(**{**dict(seed=3, record=record(), ends=(4 * PERIOD_NS, 9 * PERIOD_NS), open_loop=(0.008,),
                         square=(0, 3 * PERIOD_NS), seconds=1.0), **changed})


def test_a_run_is_measured_by_the_true_tip():
    run = a_run()
    assert_allclose(run.final, [5e-3, 0])
    assert run.tracking == pytest.approx(np.sqrt((81 + 64 + 49) / 3) * 1e-3)
    assert run.robot_seconds == pytest.approx(9 / 15) and run.blackout(1 / 15) is None
    from fluoro_shape_ros.demo.servo import line
    assert re.match(r' +3 +5\.00 0\.00 +8\.0 +8\.04 +50 +10 +6 +0\.6 +1\.0$', line(run, 15.0)), line(run, 15.0)


def test_a_blackout_is_measured_from_when_the_robot_must_stand_still():
    run = a_run()
    run.record.blackout = PERIOD_NS, 7 * PERIOD_NS
    moved, back = run.blackout(1 / 15)
    assert moved == pytest.approx(1e-3)     # the fifth to the sixth pair
    assert back == 2                        # the eighth pair was not measured, the ninth was


def test_the_referee_hears_from_diagnostics_when_the_node_has_its_mask():
    from fluoro_shape_ros.demo.servo_referee import Referee
    from msg_adapters.diagnostics import ReconstructionSummary, diagnostic_array, reconstruction_status
    from msg_adapters.messages import ros_message
    referee = Referee()
    for mask, masked in (('none', False), ('capturing, 7 of 8 pairs', False), ('in use, mean of 8 pairs', True)):
        referee._on_diagnostics(diagnostic_array([reconstruction_status(ReconstructionSummary(mask=mask))], 1,
                                                 'fluoro_shape', ros_message))
        assert referee.masked == masked


def test_plane_a_sees_the_square_as_a_square():
    from fluoro_shape_ros.demo.servo_run import _square
    seen, edge_on = (project(field.view.P, _square(np.zeros(3), 0.012))
                     for field in plant.plant('two_tubes', 0, 512, with_anatomy=False).run.fields)
    assert_allclose(np.ptp(seen, axis=0), [40, 40])         # 12 mm at 0.3 mm a pixel
    assert np.ptp(edge_on, axis=0).min() < 1e-6


def test_the_robot_takes_commands_by_name():
    from sensor_msgs.msg import JointState

    from fluoro_shape_ros.demo.servo_robot import Robot
    q = plant.ROBOTS['two_tubes'].start
    robot = Robot('two_tubes', 15.0, None)
    robot._on_command(turned(joints(q + [0.1, 0.2, 0.3, 0.4], 0)))
    # without names, without one joint, no numbers
    for refused in (JointState(position=q.tolist()), joints(q[:3], 0), joints(q * np.nan, 0)):
        robot._on_command(refused)
    assert_allclose(robot._command, q + [0.1, 0.2, 0.3, 0.4])


def test_a_ct_that_is_none_is_refused_in_one_line(tmp_path, capsys):
    from fluoro_shape_ros.demo.servo import main
    with pytest.raises(SystemExit) as left:
        main(['--ct', str(tmp_path / 'none.npz')])
    assert left.value.code == 2 and capsys.readouterr().err.rstrip().splitlines()[-1].endswith('none.npz: no such CT')


def test_the_picture_is_drawn(tmp_path):
    pytest.importorskip('matplotlib')
    import cv2

    from fluoro_shape_ros.demo.servo_plot import draw
    run, moved = a_run(), plant.plant('two_tubes', 0, 128, with_anatomy=False)
    run.record.blackout = PERIOD_NS, 3 * PERIOD_NS
    for square in (run.square, None):
        image = cv2.imread(str(draw(a_run(square=square, record=run.record), tmp_path / 'servo.png', moved)))
        assert image.shape[1] == 1200 and image.std() > 5


# ---- documentation


def test_the_example_in_the_documentation_is_the_one_that_runs():
    assert 'docs/servo.md' in (ROOT / 'README.md').read_text(encoding='utf-8')
    text = (ROOT / 'docs' / 'servo.md').read_text(encoding='utf-8')
    assert EXAMPLE in text and 'resource/servo.png' in text
    (shown,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    assert shown == resource_path(EXAMPLE).read_text(encoding='utf-8')


# ---- on real topics


def test_a_run(tmp_path):
    """One target, small images; a machine that is too slow slows the robot's clock down, too."""
    pytest.importorskip('matplotlib')
    arguments = ['--targets', '1', '--square', '0', '--size', '320', '--out', str(tmp_path), '--domain',
                 str(140 + os.getpid() % 10)]     # nobody else's
    done = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.demo.servo', *arguments], capture_output=True,
                          text=True, timeout=240)
    logs = '\n'.join(f'{log.name}: {log.read_text()}' for log in sorted(tmp_path.glob('*.log')))
    assert done.returncode == 0, f'{done.stdout}{done.stderr}{logs}'
    assert 'all 1 runs ended within 0.3 mm of every target' in done.stdout
    assert ((tmp_path / 'servo.png').stat().st_size > 10_000
            and 'Traceback' not in (tmp_path / 'node.log').read_text() + (tmp_path / 'robot.log').read_text())
