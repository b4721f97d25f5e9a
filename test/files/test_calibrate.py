"""The projection of a plane from beads, against a camera worked out by hand."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.files import calibrate
from fluoro_shape_ros.files.calibrate import (
    CalibrationError,
    pose_arguments,
    projection_from_points,
    read_beads,
    residuals_px,
)
from fluoro_shape_ros.geometry.cameras import decompose, pixels_per_metre, project, source
from fluoro_shape_ros.sim import carm
from msg_adapters.calibration import read_calibration

# Seen from (0, 0, -1) along +z, focal length 1000 px: what is at z = 0 is 1 m away, a tenth of a metre is 100 px; at
# z = 0.25 it is 80 px.
P = np.array([[1000.0, 0, 320, 320], [0, 1000, 240, 240], [0, 0, 1, 1]])
BEADS = np.array([[x, y, z] for z in (0.0, 0.25) for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
PIXELS = np.array([[220, 140], [220, 340], [420, 140], [420, 340], [240, 160], [240, 320], [400, 160], [400, 320]],
                  float)


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
    lines += [f'{k}, {", ".join(map(repr, map(float, (*scale * b, *p))))}'
              for k, (b, p) in enumerate(zip(beads, pixels))]
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
    assert ('8 beads, residual 0.000 px' in said
            and 'X-ray source at (0.0, 0.0, -1000.0) mm' in said.replace('-0.0', '0.0') and 'worse' not in said)
    c = read_calibration(out)
    assert (c.camera_name, c.width, c.height) == ('plane_a', 640, 480)
    assert_allclose(c.P, P, atol=1e-6)
    assert_allclose(c.K, P[:, :3], atol=1e-6)

    assert (calibrate.main([beads, '--size', '640', '480', '--out', out, '--force', '--tf', 'table', 'plane_a_optical'])
            == 0)
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


def table(path, text, encoding='utf-8'):
    path.write_bytes(text.encode(encoding))
    return str(path)


ROWS = [f'{x:g};{y:g};{z:g};{u:g};{v:g}' for (x, y, z), (u, v) in zip(1e3 * BEADS, PIXELS + 0.5)]
SEMICOLONS = '\r\n'.join(['x_mm;y_mm;z_mm;u_px;v_px', *ROWS]) + '\r\n'


@pytest.mark.parametrize('text', [
    SEMICOLONS,
    SEMICOLONS.replace('.', ','),                               # a spreadsheet in German
    'sep=;\n' + SEMICOLONS,
    SEMICOLONS.replace(';', '\t'),
    SEMICOLONS.replace(';', '\t').replace('.', ','),
    SEMICOLONS.replace(';', ', '),
    SEMICOLONS.replace('x_mm;y_mm;z_mm', 'X [mm];Y (mm);z_mm').replace('u_px;v_px', 'u_px;v_px;Größe'),
    '# measured on Monday\n\n' + SEMICOLONS,
], ids=['semicolons', 'decimal commas', 'sep', 'tabs', 'tabs and decimal commas', 'commas', 'brackets', 'comments'])
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16', 'utf-16-le', 'utf-16-be', 'latin-1'])
def test_tables_as_spreadsheets_write_them(tmp_path, text, encoding):
    points, pixels = read_beads(table(tmp_path / 'beads.csv', text, encoding))
    assert_allclose(points, BEADS)
    assert_allclose(pixels, PIXELS + 0.5)


@pytest.mark.parametrize('data, says', [
    (b'PK\x03\x04' + bytes(30), 'a workbook of a spreadsheet'),
    (b'\xff\xfe' + bytes([0, 0xd8]) * 3, 'no text'),
    (SEMICOLONS.replace('400.5', '400.5.1').encode(), 'line 8 has something that is no number'),
])
def test_files_that_are_no_table_are_named(tmp_path, data, says):
    (tmp_path / 'beads.csv').write_bytes(data)
    with pytest.raises(CalibrationError, match=says):
        read_beads(str(tmp_path / 'beads.csv'))


@pytest.mark.parametrize('unit, scale, says',
                         [('mm', 1, 'within 0.25 mm by its columns x_mm, y_mm, z_mm: are these metres'),
                          ('m', 1e3, 'within 250 m by its columns x_m, y_m, z_m: are these millimetres')])
def test_positions_in_another_unit_than_the_columns_say_are_noticed(tmp_path, unit, scale, says):
    with pytest.raises(CalibrationError, match=says):
        read_beads(write(tmp_path / 'beads.csv', unit=unit, scale=scale))


def refused(capsys, *arguments):
    assert calibrate.main([*arguments]) == 1
    said = capsys.readouterr()
    assert said.err.count('\n') == 1 and not said.out
    return said.err


def test_a_fit_that_can_be_none_is_refused(tmp_path, capsys):
    """Pixels of other beads: tens of px rms; and positions a tenth as deep as they are: a focal length a tenth of what
    it is."""
    out = str(tmp_path / 'a.yaml')
    mixed = write(tmp_path / 'mixed.csv', phantom(), np.roll(project(P, phantom()), 1, axis=0))
    assert 'the best projection' in refused(capsys, mixed, '--size', '640', '480', '--out', out)
    noisy = write(tmp_path / 'noisy.csv', phantom(),
                  project(P, phantom()) + np.random.default_rng(0).normal(0, 30, (40, 2)))
    assert 'misses the beads by 2' in refused(capsys, noisy, '--size', '640', '480', '--out', out)
    flat = write(tmp_path / 'flat.csv', phantom() * (1, 1, 0.08), project(P, phantom()))
    assert 'focal length' in refused(capsys, flat, '--size', '640', '480', '--out', out)
    assert not (tmp_path / 'a.yaml').exists()


def test_a_size_that_contradicts_the_beads_is_refused(tmp_path, capsys):
    beads, out = write(tmp_path / 'beads.csv'), str(tmp_path / 'a.yaml')
    assert ('4 of 8 beads lie outside an image of 400x480 px, the first is bead 3 at (420.0, 140.0)'
            in refused(capsys, beads, '--size', '400', '480', '--out', out))
    assert calibrate.main([beads, '--size', '1024', '1024', '--out', out]) == 0
    assert 'upper left quarter of 1024x1024 px: is --size right?' in capsys.readouterr().out


def test_nothing_is_overwritten(tmp_path, capsys):
    beads, out = write(tmp_path / 'beads.csv'), tmp_path / 'a.yaml'
    out.write_text('mine')
    size = ['--size', '640', '480']
    assert 'exists already and is not overwritten without --force' in refused(capsys, beads, *size, '--out', str(out))
    assert 'is what is read' in refused(capsys, beads, *size, '--out', beads, '--force')
    assert 'no folder' in refused(capsys, beads, *size, '--out', str(tmp_path / 'none' / 'a.yaml'))
    assert out.read_text() == 'mine' and len(read_beads(beads)[0]) == 8
    assert calibrate.main([beads, *size, '--out', str(out), '--force']) == 0 and read_calibration(out).width == 640


def both(tmp_path, sigma=0.0, seed=0):
    """Tables of both planes of the simulated C-arm, with noise on the pixels; those of plane B in another order, with
    one bead fewer and one more."""
    rng, points, tables = np.random.default_rng(seed), phantom(20), []
    for name, angle, order in (('a', 0.0, np.arange(20)), ('b', np.pi / 2, rng.permutation(20)[1:])):
        view = carm.view(name, angle)
        pixels = project(view.P, points[order]) + rng.normal(0, sigma, (len(order), 2))
        tables.append(write(tmp_path / f'{name}.csv', points[order], pixels))
    return tables, [str(tmp_path / f'{name}.yaml') for name in 'ab'], [str(view.width), str(view.height)]


def test_both_planes_in_one_go_with_the_error_in_millimetres(tmp_path, capsys):
    tables, out, size = both(tmp_path)
    assert calibrate.main([*tables, '--size', *size, '--out', *out]) == 0
    said = capsys.readouterr().out
    assert 'plane_b: 19 beads' in said
    assert ('both planes: 19 beads triangulated, off by 0.000 mm rms, 0.000 mm at worst; '
            '0.000 mm rms where they are left out of the fit in turn' in said)
    assert [read_calibration(path).camera_name for path in out] == ['plane_a', 'plane_b']
    assert_allclose(read_calibration(out[1]).P, carm.view('b', np.pi / 2).P, rtol=1e-5, atol=1e-3)


def test_the_error_in_millimetres_is_that_of_the_noise(tmp_path, capsys):
    """Half a pixel in each plane, a pixel being 0.3 mm at the beads: about that much each way, and more for beads that
    were not in the fit."""
    tables, out, size = both(tmp_path, sigma=0.5)
    assert calibrate.main([*tables, '--size', *size, '--out', *out]) == 0
    words = capsys.readouterr().out.split('off by ')[1].split()
    pitch_mm = 1e3 / pixels_per_metre(carm.view('a', 0.0).P, np.zeros((1, 3)))
    fitted, left_out = float(words[0]), float(words[words.index('worst;') + 1])
    assert 0.3 * pitch_mm < fitted < left_out < 2 * pitch_mm


def test_both_planes_must_differ_and_share_their_beads(tmp_path, capsys):
    tables, out, size = both(tmp_path)
    assert 'coincide' in refused(capsys, tables[0], tables[0], '--size', *size, '--out', *out)
    moved = write(tmp_path / 'c.csv', phantom(20) + 0.01, project(carm.view('b', np.pi / 2).P, phantom(20) + 0.01))
    assert calibrate.main([tables[0], moved, '--size', *size, '--out', *out]) == 0
    assert 'no bead is in both tables' in capsys.readouterr().out


@pytest.mark.parametrize('given',
                         [[], ['a.csv'], ['a.csv', '--size', '640'], ['a.csv', 'b.csv', '--size', '640', '480'],
                          ['a.csv', '--size', '640', '480', '--board', '9', '6'],
                          ['--pictures-a', 'a.png'], ['--pictures-b', 'a.png', '--board', '9', '6', '--square', '10'],
                          ['--pictures-a', 'a.png', '--pictures-b', 'b.png', '--board', '8', '6', '--square', '10'],
                          ['--pictures-a', 'a.png', '--board', '9', '6', '--square', '10', '--charuco', 'DICT_4X4_50']],
                         ids=' '.join)
def test_unusable_arguments(given, capsys):
    with pytest.raises(SystemExit, match='2'):
        calibrate.main([*given, '--out', 'a.yaml'])
    assert 'fluoro_shape_calibrate: error: ' in capsys.readouterr().err


def test_the_module_is_a_command():
    done = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.files.calibrate', '--help'], capture_output=True,
                          text=True, timeout=60)
    assert done.returncode == 0 and 'u_px' in done.stdout
