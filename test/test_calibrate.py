"""The projection of a plane from beads, against a camera worked out by hand."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.geometry.cameras import decompose, project, source
from fluoro_shape_ros.sim import carm
from fluoro_shape_ros.tools import calibrate
from fluoro_shape_ros.tools.calibrate import CalibrationError, pose_arguments, projection_from_points, read_beads, residuals_px
from msg_adapters.calibration import read_calibration

# Seen from (0, 0, -1) along +z, focal length 1000 px: what is at z = 0 is 1 m away, a tenth of a metre is 100 px; at z = 0.25 it is 80 px.
P = np.array([[1000.0, 0, 320, 320], [0, 1000, 240, 240], [0, 0, 1, 1]])
BEADS = np.array([[x, y, z] for z in (0.0, 0.25) for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
PIXELS = np.array([[220, 140], [220, 340], [420, 140], [420, 340], [240, 160], [240, 320], [400, 160], [400, 320]], float)


def test_a_camera_worked_out_by_hand():
    assert_allclose(projection_from_points(BEADS, PIXELS), P, atol=1e-6)


def test_six_beads_will_do():
    keep = [0, 1, 3, 4, 6, 7]
    assert_allclose(projection_from_points(BEADS[keep], PIXELS[keep]), P, atol=1e-6)


def test_a_mirrored_image_is_a_camera_too():
    fitted = projection_from_points(BEADS, PIXELS * (-1, 1) + (640, 0))
    assert_allclose(fitted, P * [[-1], [1], [1]] + [[0, 0, 640, 640], [0] * 4, [0] * 4], atol=1e-6)
    K, R, _ = decompose(fitted)
    assert K[0, 0] == pytest.approx(-1000) and np.linalg.det(R) == pytest.approx(1)


def phantom(count=40, seed=0):
    return np.random.default_rng(seed).uniform(-0.06, 0.06, (count, 3))


def test_noise_is_averaged_and_the_result_is_the_best_one():
    view, points = carm.view('a', 0.3, 0.1), phantom()
    noisy = project(view.P, points) + np.random.default_rng(1).normal(0, 0.2, (40, 2))
    fitted = projection_from_points(points, noisy)
    rms = lambda P: np.sqrt(np.mean(residuals_px(P, points, noisy)**2) / 2)    # noqa: E731
    assert rms(fitted) < rms(view.P) < 0.25     # closer to the noisy pixels than the truth is
    rng = np.random.default_rng(2)
    assert all(rms(fitted * (1 + rng.normal(0, 1e-6, (3, 4)))) > rms(fitted) for _ in range(50))
    assert np.abs(project(fitted, phantom(seed=3)) - project(view.P, phantom(seed=3))).max() < 0.5


@pytest.mark.parametrize('points, pixels, says', [
    (BEADS[:5], PIXELS[:5], '5 beads and 5 pixels'),
    (BEADS, PIXELS[:7], '8 beads and 7 pixels'),
    (BEADS * (1, 1, 0), PIXELS, 'in one plane'),
    (np.tile(BEADS[:1], (8, 1)), PIXELS, 'in one plane'),
    (np.where(BEADS == 0.25, np.nan, BEADS), PIXELS, 'finite'),
])
def test_beads_that_do_not_tell_are_refused(points, pixels, says):
    with pytest.raises(CalibrationError, match=says):
        projection_from_points(points, pixels)


def test_the_pose_is_that_of_the_source():
    words = pose_arguments(carm.view('a', 0.0).P, 'isocenter', 'plane_a_optical').split()
    given = dict(zip(words[::2], words[1::2]))
    assert (given['--frame-id'], given['--child-frame-id']) == ('isocenter', 'plane_a_optical')
    assert_allclose([float(given[f'--{name}']) for name in 'xyz'], [0, 0.81, 0], atol=1e-8)     # behind the patient
    R = Rotation.from_quat([float(given[f'--q{name}']) for name in 'xyzw']).as_matrix()
    assert_allclose(R @ [0, 0, 1], [0, -1, 0], atol=1e-8)   # its z axis runs to the front


def write(path, beads=BEADS, pixels=PIXELS, unit='mm', scale=1e3):
    lines = [f'bead, x_{unit}, y_{unit}, z_{unit}, u_px, v_px']
    lines += [f'{k}, {", ".join(map(repr, map(float, (*scale * b, *p))))}' for k, (b, p) in enumerate(zip(beads, pixels))]
    path.write_text('\n'.join(lines) + '\n')
    return str(path)


@pytest.mark.parametrize('unit, scale', [('mm', 1e3), ('m', 1)])
def test_reads_beads_in_either_unit(tmp_path, unit, scale):
    points, pixels = read_beads(write(tmp_path / 'beads.csv', unit=unit, scale=scale))
    assert_allclose(points, BEADS)
    assert_allclose(pixels, PIXELS)


def test_the_command_writes_the_file_and_says_how_good_it_is(tmp_path, capsys):
    pytest.importorskip('yaml')
    wrong = PIXELS.repeat(2, axis=0) + np.random.default_rng(0).normal(0, 0.05, (16, 2))
    wrong[5] += 9
    beads = write(tmp_path / 'beads.csv', BEADS.repeat(2, axis=0), wrong)
    assert calibrate.main([beads, '--size', '640', '480', '--out', str(tmp_path / 'b.yaml')]) == 0
    assert 'bead 6 fits much worse' in capsys.readouterr().out

    beads, out = write(tmp_path / 'beads.csv'), str(tmp_path / 'a.yaml')
    assert calibrate.main([beads, '--size', '640', '480', '--out', out, '--name', 'plane_a']) == 0
    said = capsys.readouterr().out
    assert '8 beads, residual 0.000 px' in said and 'X-ray source at (0.0, 0.0, -1000.0) mm' in said.replace('-0.0', '0.0') and 'worse' not in said
    c = read_calibration(out)
    assert (c.camera_name, c.width, c.height) == ('plane_a', 640, 480)
    assert_allclose(c.P, P, atol=1e-6)
    assert_allclose(c.K, P[:, :3], atol=1e-6)

    assert calibrate.main([beads, '--size', '640', '480', '--out', out, '--tf', 'table', 'plane_a_optical']) == 0
    assert '--frame-id table --child-frame-id plane_a_optical' in capsys.readouterr().out
    assert_allclose(read_calibration(out).P, np.c_[P[:, :3], np.zeros(3)], atol=1e-6)
    assert_allclose(source(P), [0, 0, -1])


@pytest.mark.parametrize('text, says', [
    ('x,y,z,u,v\n1,2,3,4,5\n', 'needs a first line with x_mm'),
    ('', 'an empty one'),
    ('x_mm,y_mm,z_mm,u_px,v_px\n1,2,3,4\n', 'line 2'),
    ('x_mm,y_mm,z_mm,u_px,v_px\n1,2,3,4,5\n', '1 beads'),
])
def test_a_failure_is_one_line(tmp_path, capsys, text, says):
    pytest.importorskip('yaml')
    (tmp_path / 'beads.csv').write_text(text)
    assert calibrate.main([str(tmp_path / 'beads.csv'), '--size', '640', '480', '--out', str(tmp_path / 'a.yaml')]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and says in error and not (tmp_path / 'a.yaml').exists()


def test_the_module_is_a_command():
    done = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.tools.calibrate', '--help'], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and 'u_px' in done.stdout
