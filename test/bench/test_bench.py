"""The bench through its command line; its counts, table and picture by hand; its families by what they promise."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.bench import composites, families, main, speed, table
from fluoro_shape_ros.bench import score as trial
from fluoro_shape_ros.bench.bound import Bound
from fluoro_shape_ros.bench.score import Answer, Task, Trial
from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.geometry.cameras import decompose, project, source
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.sim import carm, scenes

SMALL = carm.biplane(arm=carm.CArm(pixel_size_iso=1e-3, width=320, height=320))


def errors(mean_mm, tip_mm):
    return Errors(mean_mm / 1000, 0.0, 0.0, tip_mm / 1000, 0.0, 0.0)


def found(mean_mm, tip_mm, surprise=float('nan'), seed=0):
    return Answer(seed, Outcome.OK, errors=errors(mean_mm, tip_mm), surprise=surprise)


GIVEN = [found(0.1, 0.5, 1.0), found(0.3, 1.0, 7.8), found(0.32, 0.1, 7.9), found(0.1, 1.1), found(1.2, 0.1),
         found(0.1, 2.5), Answer(6, Outcome.CURVATURE), Answer(7, Outcome.CURVATURE), Answer(8, Outcome.LENGTH)]


def test_row_counts_what_is_good_wrong_and_honest():
    row = table.row(GIVEN)
    assert (row.scenes, row.answered, row.within, row.silent, row.reported, row.honest) == (9, 6, 2, 2, 3, 2)
    assert row.rejections == {'curvature_too_high': 2, 'length_out_of_bounds': 1}
    assert_allclose([row.errors['mean'].mean, row.errors['mean'].worst], [2.12e-3 / 6, 1.2e-3])
    # a quarter of a place below the last of six: 1.1, 2.5
    assert_allclose(row.errors['tip'].p95, 2.5e-3 - 0.25 * 1.4e-3)


def test_where_no_device_is_every_shape_is_a_silent_failure():
    row = table.row([Answer(0, Outcome.OK, device=False), Answer(1, Outcome.NO_DEVICE_A, device=False)])
    assert (row.device, row.answered, row.silent, row.within, row.errors) == (False, 1, 1, 0, {})


def test_table_has_a_line_a_family_and_method():
    trials = [Trial(Task('p', k, ('spline', 'paper')), {'spline': answer, 'paper': Answer(k, Outcome.NO_DEVICE_A)},
                    Bound(2e-5, 1e-4, 9e-5))
              for k, answer in enumerate(GIVEN)]
    trials.append(Trial(Task('blank', 0, ('spline', 'paper')),
                        {m: Answer(0, Outcome.NO_DEVICE_B, device=False) for m in ('spline', 'paper')}, None))
    lines = table.table(table.rows(trials)).splitlines()
    assert max(map(len, lines)) < 140
    shares, errors_mm = lines[1:5], [line.split() for line in lines[7:9]]
    assert shares[0].split() == 'p spline 9 67 % 22 % 2 67 % 2 curvature_too_high, 1 length_out_of_bounds'.split()
    assert shares[1].split() == 'paper 9 0 % 0 % 0 - 9 no_device_in_plane_a'.split()
    assert shares[2].split() == 'blank spline 1 0 % - 0 - 1 no_device_in_plane_b'.split()
    assert errors_mm[0][:5] == ['p', 'spline', '0.353', '0.980', '1.200']
    assert errors_mm[1] == ['bound', *['0.020'] * 3, '-', *['0.100'] * 3, *['0.090'] * 3, '-']
    assert lines[-2:] == ['spline: 2 silent failures in 10 scenes (20.0 %)',
                          'paper: 0 silent failures in 10 scenes (0.0 %)']


def test_plot_shows_silent_failures_in_their_colour(tmp_path):
    pytest.importorskip('matplotlib')
    from fluoro_shape_ros.bench import plot

    def red_pixels(answers):
        file = tmp_path / 'bench.png'
        plot.draw([Trial(Task('p', k, ('spline',)), {'spline': a}, Bound(2e-5, 1e-4, 9e-5))
                   for k, a in enumerate(answers)], file)
        image = cv2.imread(str(file)).astype(int)
        assert image.shape[1] == 1500 and image.std() > 5
        return (np.abs(image - [0x5f, 0x5a, 0xff]).max(axis=2) < 3).sum()

    assert red_pixels(GIVEN) > 2 * red_pixels(GIVEN[:2]) > 0       # the legend has it in any case


class Canned:
    """Stands in for the pipeline: keeps what it is asked and answers the same each time."""

    def __init__(self, shape):
        self.shape = shape

    def __call__(self, frame, config, prior):
        self.config, self.prior = config, prior
        return (Reconstruction(Outcome.OK, 'ok', self.shape)
                if self.shape else Reconstruction(Outcome.LENGTH, 'too long'))


def case(**options):
    scene = scenes.xray_run(0, views=SMALL, lengths=(0.067, 0.1), anatomy=False, radius=0.001).scene()
    return families.Case(scene, **options)


def test_answer_gives_what_a_user_knows_and_measures_what_comes(monkeypatch):
    masks = (np.ones((320, 320), np.float32),) * 2
    given = case(masks=masks, note='a note')
    truth, n = given.scene.truth, len(given.scene.truth)
    shape = Shape(truth + [0, 0, 1e-3], np.linspace(0, 0.1, n), np.broadcast_to(np.eye(3) * 0.25e-6, (n, 3, 3)),
                  np.zeros((n, 2)))
    monkeypatch.setattr(trial, 'reconstruct', pipeline := Canned(shape))
    answer = trial.answer(given, Config())
    assert pipeline.prior.masks is masks and pipeline.config.detection.robot_radius == 0.001
    assert_allclose(pipeline.config.curve.base_position, truth[0])
    assert_allclose([answer.errors.tip, answer.surprise], [1e-3, 4.0])      # two sigmas off
    assert answer.published and answer.note == 'a note' and not answer.silent_failure
    assert trial.answer(given, Config(), device=False).silent_failure
    monkeypatch.setattr(trial, 'reconstruct', Canned(None))
    answer = trial.answer(given, Config())
    assert (answer.errors, answer.published, answer.detail) == (None, False, 'too long')


def test_accuracy_is_written_as_json_and_does_not_depend_on_the_number_of_jobs(tmp_path, capfd):
    def run(jobs):
        file = tmp_path / f'{jobs}.json'
        assert main.main(['accuracy', '--families', 'p_xray', '--methods', 'spline', '--scenes', '2', '--first-seed',
                          '7', '--jobs', str(jobs),
                           '--json', str(file)]) == 0
        return file.read_text(), capfd.readouterr().out

    (text, out), (text_of_two, out_of_two) = run(1), run(2)
    assert text == text_of_two and out == out_of_two
    assert 'p_xray      spline' in out and '            bound' in out
    content = json.loads(text)
    assert [(t['family'], t['seed']) for t in content['trials']] == [('p_xray', 7), ('p_xray', 8)]
    for t in content['trials']:
        answer = t['answers']['spline']
        assert (answer['errors_m'] is None) == (answer['outcome'] != 'ok')
        assert 1e-5 < t['bound_m']['mean'] < 4e-5
    assert content['rows']['p_xray/spline']['scenes'] == 2


@pytest.mark.parametrize('arguments, code, word', [
    (['accuracy', '--scenes', 'many'], 2, '--scenes'),
    (['accuracy', '--scenes', '0'], 2, '--scenes'),
    (['accuracy', '--first-seed', '-1'], 2, '--first-seed'),
    (['accuracy', '--families', 'nosuch'], 2, 'nosuch'),
    (['robustness', '--families', 'real'], 2, '--real'),
    (['accuracy', '--methods', 'guess'], 2, 'guess'),
    (['accuracy', '--plot', 'bench.doc'], 2, '.png'),
    (['accuracy', '--json', '/no/such/folder/bench.json'], 1, 'no such folder'),
    (['robustness', '--real', '/no/such/folder'], 1, 'background_plane_a.png'),
])
def test_what_cannot_be_benched_is_named_at_once(arguments, code, word, capsys):
    try:
        assert main.main(arguments) == code
    except SystemExit as stop:
        assert stop.code == code
    assert word in capsys.readouterr().err.splitlines()[-1]


def test_help_names_all_families():
    for command, group in (('accuracy', families.ACCURACY), ('robustness', families.ROBUSTNESS)):
        text = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.bench.main', command, '--help'],
                              capture_output=True, text=True, check=True).stdout
        assert all(f'  {name} ' in text for name in group)


def plane_about_baseline(points, views):
    """(N,) rad: which of the pencil of epipolar planes holds each point."""
    a, b = (source(v.P) for v in views)
    axis = (b - a) / np.linalg.norm(b - a)
    first = np.cross(axis, [0.0, 0.0, 1.0])
    return np.arctan2((points - a) @ np.cross(axis, first), (points - a) @ first)


@pytest.mark.parametrize('seed', range(3))
def test_tangent_device_turns_back_among_the_epipolar_planes(seed):
    points = scenes.xray_run(seed, views=SMALL, anatomy=False, kind='tangent').backbone()
    angle = plane_about_baseline(points, SMALL)
    rising = np.diff(angle) > 0
    assert rising[100:-100].any() and not rising[100:-100].all()


@pytest.mark.parametrize('seed', range(3))
def test_crossing_device_meets_itself_in_an_image(seed):
    points = scenes.xray_run(seed, views=SMALL, anatomy=False, kind='crossing', lengths=families.LONG).backbone()[::5]
    apart = np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points)))) * 0.5e-3
    nearest = [np.linalg.norm(uv[:, None] - uv[None], axis=2)[apart > 0.02].min()
               for uv in (project(v.P, points) for v in SMALL)]
    assert min(nearest) < 0.4       # px, of steps of half a pixel


@pytest.mark.parametrize('seed', range(4))
def test_plate_hides_so_many_pixels_in_one_plane(seed):
    options = dict(views=SMALL, lengths=(0.067, 0.1), anatomy=False)
    run, free = scenes.xray_run(seed, hidden_px=12.0, **options), scenes.xray_run(seed, **options)
    hidden = []
    for view, beam, open_beam in zip(SMALL, run.beams, free.beams):
        uv = project(view.P, run.backbone())
        u, v = np.rint(uv).astype(int).T
        steps = np.linalg.norm(np.diff(uv, axis=0), axis=1)
        hidden.append(steps[(beam / open_beam)[v[1:], u[1:]] < 0.05].sum())
        assert beam[v[-50:], u[-50:]].min() > 0.9       # not the tip
    assert min(hidden) == 0 and 9 < max(hidden) < 16


def test_calibration_is_off_by_half_a_pixel_and_nothing_else():
    wrong, right = (families.ROBUSTNESS[name].make(3).scene for name in ('calibration', 'anatomy'))
    np.testing.assert_array_equal(wrong.frame.images, right.frame.images)
    off = [project(w.P, right.truth) - project(r.P, right.truth) for w, r in zip(wrong.frame.views, right.frame.views)]
    assert_allclose(off[0], 0)
    assert_allclose(np.linalg.norm(off[1], axis=1), 0.5)


@pytest.mark.parametrize('name, seed, planes', [('blank', 0, ()), ('one_plane', 0, (0,)), ('one_plane', 1, (1,)),
                                                ('p_xray', 0, (0, 1))])
def test_device_is_seen_in_the_planes_it_should_be_seen_in(name, seed, planes):
    family = families.families()[name]
    scene = family.make(seed).scene
    assert family.device == (planes == (0, 1))
    for i, (image, view) in enumerate(zip(scene.frame.images, scene.frame.views)):
        u, v = np.rint(project(view.P, scene.truth[20:-20:10])).astype(int).T
        assert (image[v, u].mean() < 0.8 * np.median(image)) == (i in planes)


def test_mask_is_the_scene_without_device_a_little_aside():
    given = families.ROBUSTNESS['masked'].make(0)
    for image, mask, view in zip(given.scene.frame.images, given.masks, given.scene.frame.views):
        u, v = np.rint(project(view.P, given.scene.truth[50:-50:10])).astype(int).T
        assert np.median(image[v, u] / mask[v, u]) < 0.92
        far = np.ones(image.shape, bool)
        far[v.min() - 9:v.max() + 9, u.min() - 9:u.max() + 9] = False
        assert abs(np.median(image[far] / mask[far]) - 1) < 0.02


@pytest.fixture
def real(tmp_path):
    """A folder of backgrounds of 256 px: bright, each with a dark bar; its origin is not the isocentre."""
    calibration = {}
    for view in carm.biplane(arm=carm.CArm(pixel_size_iso=1e-3, width=256, height=256)):
        image = np.full((256, 256), 180, np.uint8)
        image[:, 30:50] = 90
        cv2.imwrite(str(tmp_path / f'background_plane_{view.name}.png'), image)
        K, R, t = decompose(view.P)
        biased = K + np.array([[0, 0, 50.0], [0, 0, 0], [0, 0, 0]])
        calibration[f'plane_{view.name}'] = dict(K=biased.tolist(), K_corrected=K.tolist(), R=R.tolist(),
                                                 t=(t + R @ [0.3, -0.2, 0.1]).tolist())
    (tmp_path / 'calibration.json').write_text(json.dumps(calibration))
    return tmp_path


def test_composite_darkens_the_background_where_the_device_is(real):
    scene, masks = composites.composite(0, real, masked=True)
    for image, mask, view in zip(scene.frame.images, masks, scene.frame.views):
        assert (image.dtype, mask.dtype) == (np.uint8, np.float32)
        background = np.where((np.arange(256) >= 30) & (np.arange(256) < 50), 90.0, 180.0)
        assert_allclose(np.median(mask, axis=0), background, atol=3)
        darker = image - mask < -12
        u, v = np.rint(project(view.P, scene.truth)).astype(int).T
        near = cv2.dilate(cv2.polylines(np.zeros((256, 256), np.uint8), [np.c_[u, v]], False, 1), np.ones((5, 5))) > 0
        assert darker[near].sum() > 20 and darker[~near].mean() < 1e-3
    bare, none = composites.composite(0, real, device=False)
    assert none is None and (bare.frame.images[0] - masks[0] < -12).mean() < 1e-3


def test_composites_enter_through_the_border_every_second_time(real):
    for seed, expected in ((0, False), (1, True)):
        scene, _ = composites.composite(seed, real)
        room = min(np.minimum(uv, 255 - uv).min() for uv in (project(v.P, scene.truth[:1]) for v in scene.frame.views))
        assert (room < 1) == expected


def test_bad_folders_are_named(real, tmp_path_factory):
    (real / 'calibration.json').write_text('{"plane_a": {}}')
    with pytest.raises(ToolError, match='calibration.json'):
        composites.load(real)
    with pytest.raises(ToolError, match='background_plane_a.png'):
        composites.load(tmp_path_factory.mktemp('empty'))


def test_speed_is_printed_full_and_tracked_and_written(tmp_path, capsys):
    file = tmp_path / 'speed.json'
    assert main.main(['speed', '--sizes', '1024', '--scenes', '2', '--first-seed', '5', '--rounds', '1', '--alone',
                      '--json', str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[7:24].strip() for line in lines[1:3]] == ['spline, full', 'spline, tracked']
    assert (any('spline, full: search' in line for line in lines)
            and any('spline, tracked: track' in line for line in lines))
    full, tracked = json.loads(file.read_text())['laps']
    for laps in (full, tracked):
        assert 0 < laps['right'] == len(laps['seconds']) <= 2 and len(laps['yardsticks']) == laps['right']
        assert all(0 < sum(stages) for stages in laps['stages'].values())
        assert_allclose(laps['median_y'], np.median(laps['seconds']) / np.median(laps['yardsticks']))


def test_growth_is_of_the_cost_per_pixel_in_yardsticks():
    """Twice the width is four times the pixels: 8 Y instead of 2 Y is as much a pixel, whatever Y was just then; 16 Y
    is twice as much."""
    small, same, more = (speed.Laps(size, speed.SPLINE, seconds=[s], yardsticks=[y], cpu=[s])
                         for size, s, y in ((512, 2.0, 1.0), (1024, 24.0, 3.0), (1024, 16.0, 1.0)))
    found = [small, same, more]
    assert_allclose([speed.growth(laps, found) for laps in found], [1, 1, 2])
    assert_allclose(small.ns_per_pixel, 1e9 / 512**2)


def test_what_is_wrong_is_not_timed(monkeypatch, capsys):
    monkeypatch.setattr(speed, 'reconstruct', lambda frame, *_: Reconstruction(Outcome.NO_DEVICE_A))
    monkeypatch.setattr(speed, 'sequences', lambda *_: [(case().scene,) * 3])
    found = speed.measure(320, 1, 1, 0, compared=0)
    assert [(laps.scenes, laps.right, laps.seconds) for laps in found] == [(1, 0, [])] * 2
    assert 'nan' in speed.table(found + [speed.Laps(320, speed.PAPER, 1, 0, [1.0], [0.1], [1.0])])
    assert main.main(['speed', '--sizes', '320', '--scenes', '1', '--alone']) == 1
    assert 'none of 1 scenes' in capsys.readouterr().err
