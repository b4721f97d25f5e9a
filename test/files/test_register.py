"""The registration of a robot and the C-arm's reference frame, against a pose worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.files import calibrate
from fluoro_shape_ros.files.beads import CalibrationError
from fluoro_shape_ros.files.register import errors, fit_pose, read_touched

# the robot's x is the reference's y, its y the reference's -x; it stands 0.1 m along z
R, T = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.0, 0, 0.1])
ROBOT = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05], [0.03, 0.02, 0.01]])
SEEN = np.array([[0.0, 0, 0.1], [0, 0.05, 0.1], [-0.05, 0, 0.1], [0, 0, 0.15], [-0.02, 0.03, 0.11]])


def write(path, robot=ROBOT, seen=SEEN, scale=1e3, unit='mm'):
    lines = [', '.join(f'{prefix}{axis}_{unit}' for prefix in ('robot_', '') for axis in 'xyz')]
    lines += [', '.join(f'{scale * v:.9g}' for v in (*a, *b)) for a, b in zip(robot, seen)]
    path.write_text('\n'.join(lines) + '\n')
    return str(path)


def test_a_pose_worked_out_by_hand(tmp_path, capsys):
    found = fit_pose(ROBOT, SEEN)
    assert np.allclose(found[0], R) and np.allclose(found[1], T)
    assert calibrate.main(['--register', write(tmp_path / 'points.csv'), '--tf', 'isocenter', 'robot_base']) == 0
    said, command = capsys.readouterr().out.splitlines()
    assert said.startswith('5 points, missed by 0.000 mm rms') and '0.000 mm rms where they are left out' in said
    words = command.split()
    given = dict(zip(words[4::2], words[5::2]))
    assert (words[:4] == ['ros2', 'run', 'tf2_ros', 'static_transform_publisher']
            and (given['--frame-id'], given['--child-frame-id']) == ('isocenter', 'robot_base'))
    assert np.allclose([float(given[f'--{name}']) for name in 'xyz'], T)
    assert np.allclose(Rotation.from_quat([float(given[f'--q{name}']) for name in 'xyzw']).as_matrix(), R)


@pytest.mark.parametrize('unit, scale', [('mm', 1e3), ('m', 1)])
def test_reads_points_in_either_unit(tmp_path, unit, scale):
    robot, seen = read_touched(write(tmp_path / 'points.csv', unit=unit, scale=scale))
    assert np.allclose(robot, ROBOT) and np.allclose(seen, SEEN)


def test_noise_is_averaged_and_told():
    """0.5 mm each way of 40 points: what is missed is that, and points left out of the fit are missed by a little
    more."""
    rng = np.random.default_rng(0)
    robot = rng.uniform(-0.05, 0.05, (40, 3))
    turn = Rotation.from_euler('xyz', [20, -30, 70], degrees=True).as_matrix()
    seen = robot @ turn.T + [0.1, 0.2, 0.3] + rng.normal(0, 5e-4, (40, 3))
    found = fit_pose(robot, seen)
    assert (Rotation.from_matrix(found[0] @ turn.T).magnitude() < 0.005
            and np.linalg.norm(found[1] - [0.1, 0.2, 0.3]) < 3e-4)
    fitted, left_out = (np.sqrt(np.mean(e**2)) for e in (errors(robot, seen, found), errors(robot, seen)))
    assert 7e-4 < fitted < left_out < 1.1e-3        # sqrt(3) * 0.5 mm


@pytest.mark.parametrize('robot, seen, says', [
    (ROBOT[:3], SEEN[:3], '3 points'),
    (ROBOT * [1, 0, 0], SEEN * [0, 1, 0], 'on a line'),
    (ROBOT, SEEN * 1000, 'distances in the reference frame are 1e\\+03 times'),
    (ROBOT, SEEN * [1, 1, -1], 'left-handed'),
    (ROBOT, SEEN[[3, 1, 4, 0, 2]], 'do not belong together'),
    (ROBOT, SEEN * np.nan, 'finite'),
])
def test_points_that_do_not_tell_are_refused(robot, seen, says):
    with pytest.raises(CalibrationError, match=says):
        fit_pose(robot, seen)


def test_the_command_says_in_one_line_what_can_not_work(tmp_path, capsys):
    (tmp_path / 'empty.csv').write_text('x_mm,y_mm,z_mm\n')
    for path, says in ((tmp_path / 'empty.csv', 'needs a first line with robot_x_mm'),
                       (write(tmp_path / 'few.csv', ROBOT[:3], SEEN[:3]), 'few.csv: 3 points'),
                       (tmp_path / 'none.csv', 'none.csv')):
        assert calibrate.main(['--register', str(path), '--tf', 'a', 'b']) == 1
        error = capsys.readouterr().err
        assert says in error and error.count('\n') == 1
    for more in ([], ['--tf', 'a'], ['--tf', 'a', 'b', '--out', 'c.yaml'], ['--tf', 'a', 'b', '--size', '3', '3']):
        with pytest.raises(SystemExit, match='2'):
            calibrate.main(['--register', 'x.csv', *more])
