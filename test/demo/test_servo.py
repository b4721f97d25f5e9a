"""The servo demo: its controller by hand, its bookkeeping, the robots it moves, its documentation, and one run on real topics."""

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

from fluoro_shape_ros.resources import resource_path
from fluoro_shape_ros.sim import plant
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
    msg = JointState(position=list(q))
    return stamped(msg, k)


def point(xyz, k=0):
    from geometry_msgs.msg import PointStamped
    msg = PointStamped()
    msg.point.x, msg.point.y, msg.point.z = map(float, xyz)
    return stamped(msg, k)


def stamped(msg, k):
    msg.header.stamp.sec, msg.header.stamp.nanosec = 1, k * PERIOD_NS
    return msg


def test_it_goes_a_third_of_the_way_from_where_the_joints_were(controller):
    node, sent = controller
    robot, q = plant.ROBOTS['two_tubes'].robot, plant.ROBOTS['two_tubes'].start
    tip, target = np.zeros(3), np.array([1e-3, -2e-3, 1e-3])      # the model is elsewhere: only the difference counts
    node.on_target(point(target))
    for k, moved in enumerate((q, q + 0.001)):
        node.on_joint_states(joints(moved, k))
    sent.clear()
    node.on_tip(point(tip, 0))
    (command,) = sent
    step = robot.backbone(np.array(command.position), 5e-4)[-1] - robot.backbone(q, 5e-4)[-1]
    assert_allclose(step, 0.35 * target, atol=0.15e-3)


def test_it_stays_where_it_is_once_the_tip_is_older_than_two_pair_times(controller):
    node, sent = controller
    q = plant.ROBOTS['two_tubes'].start
    node.on_target(point([0.01, 0, 0]))
    node.on_joint_states(joints(q, 0))
    node.on_tip(point([0, 0, 0], 0))
    sent.clear()
    for k in (1, 2):
        node.on_joint_states(joints(q + k, k))
    assert not sent
    node.on_joint_states(joints(q + 3, 3))
    assert_allclose(sent.pop().position, q + 3)
    node.on_tip(point([0, 0, 0], 0))        # too old to act on, and so is one without joints
    node.on_tip(point([0, 0, 0], 9))
    assert not sent


# ---- bookkeeping


def record():
    """Ten pairs; the true tip comes 1 mm nearer each, the fourth to seventh are not measured."""
    from fluoro_shape_ros.demo.servo_referee import Record
    true = {k * PERIOD_NS: np.array([(9 - k) * 1e-3, 0.0, 0.0]) for k in range(10)}
    return Record(target={t: np.zeros(3) for t in true}, true=true, measured={t: x for k, (t, x) in enumerate(true.items()) if not 4 <= k < 8},
                  joints=dict.fromkeys(true, plant.ROBOTS['two_tubes'].start), delays=[0.05])


def a_run(**changed):
    from fluoro_shape_ros.demo.servo_run import Run
    return Run(**{**dict(seed=3, record=record(), ends=(4 * PERIOD_NS, 9 * PERIOD_NS), open_loop=(0.008,), square=(0, 3 * PERIOD_NS), seconds=1.0), **changed})


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
        referee._on_diagnostics(diagnostic_array([reconstruction_status(ReconstructionSummary(mask=mask))], 1, 'fluoro_shape', ros_message))
        assert referee.masked == masked


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
    for file in ('README.md', 'docs/servo.md'):
        text = (ROOT / file).read_text(encoding='utf-8')
        if file == 'README.md':
            assert EXAMPLE in text and 'resource/servo.png' in text
            continue
        (shown,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
        assert shown == resource_path(EXAMPLE).read_text(encoding='utf-8')


# ---- on real topics


def test_a_run(tmp_path):
    """One target, small images; a machine that is too slow slows the robot's clock down, too."""
    pytest.importorskip('matplotlib')
    arguments = ['--targets', '1', '--square', '0', '--size', '320', '--out', str(tmp_path), '--domain', str(140 + os.getpid() % 10)]     # nobody else's
    done = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.demo.servo', *arguments], capture_output=True, text=True, timeout=240)
    logs = '\n'.join(f'{log.name}: {log.read_text()}' for log in sorted(tmp_path.glob('*.log')))
    assert done.returncode == 0, f'{done.stdout}{done.stderr}{logs}'
    assert 'all 1 runs ended within 0.3 mm of every target' in done.stdout
    assert (tmp_path / 'servo.png').stat().st_size > 10_000 and 'Traceback' not in (tmp_path / 'node.log').read_text() + (tmp_path / 'robot.log').read_text()
