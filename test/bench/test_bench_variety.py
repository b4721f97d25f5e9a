"""The bench on varied scenes: its counts, table and sheets by hand, scenes from elsewhere from a folder, and the whole
through its command line."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.bench import families, main, open_scenes, sheets, variety
from fluoro_shape_ros.bench import score as trial
from fluoro_shape_ros.bench.case import Case, Family
from fluoro_shape_ros.bench.score import Answer, Task, Trial
from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Reconstruction
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.sim import carm, scenes

SMALL = carm.biplane(arm=carm.CArm(pixel_size_iso=1e-3, width=320, height=320))
REFUSED = Answer(0, Outcome.LENGTH, cpu_s=0.5)


def drawn(seed):
    """A scene that takes hundredths of a second; so few px of a device are found, but not believed with the usual
    confidence."""
    return scenes.xray_run(seed, views=SMALL, lengths=(0.067, 0.1), anatomy=False, radius=0.001).scene()


def save(folder, scene, **changes):
    """Write a scene as one from elsewhere; `changes` replace entries of scene.json, None removes one."""
    folder.mkdir(parents=True)
    for name, image in zip(open_scenes.IMAGES, scene.frame.images):
        cv2.imwrite(str(folder / name), image)
    a, b = scene.frame.views
    about = dict(family='rod', device=True, P_a=a.P.tolist(), P_b=b.P.tolist(), radius_m=scene.radius,
                 backbone_m=scene.truth.tolist(), entering=False) | changes
    (folder / 'scene.json').write_text(json.dumps({name: value for name, value in about.items() if value is not None}))


def hide(folder):
    """Plane B of a saved scene shows nothing any more, so that it is refused."""
    file = str(folder / 'plane_b.png')
    image = cv2.imread(file, cv2.IMREAD_UNCHANGED)
    cv2.imwrite(file, np.full_like(image, int(np.median(image))))


@pytest.fixture
def folder(tmp_path):
    """Four scenes: three rods, of which the third is refused, and between them one pair without a device."""
    for seed in range(3):
        save(tmp_path / 'scenes' / f'rod_{seed}', drawn(seed))
    hide(tmp_path / 'scenes' / 'rod_2')
    blank = scenes.xray_run(9, views=SMALL, lengths=(0.067, 0.1), anatomy=False)
    save(tmp_path / 'scenes' / 'none_0', replace(blank.scene(), frame=blank.without_device()), family='none',
         device=False, backbone_m=[])
    return tmp_path / 'scenes'


def found(mean_mm, tip_mm, **rest):
    return Answer(0, Outcome.OK, errors=Errors(mean_mm / 1000, 0.0, 0.0, tip_mm / 1000, 0.0, 0.0), **rest)


# ---- counts and table


@pytest.mark.parametrize('mean_mm, tip_mm, px_mm, right', [
    (0.3, 1.0, 0.1, True), (0.31, 1.0, 0.1, False), (0.3, 1.01, 0.1, False), (0.3, 1.0, math.nan, True),
    (0.31, 1.0, 0.31, True), (0.4, 1.2, 0.4, True), (0.4, 1.21, 0.4, False), (0.41, 1.2, 0.4, False),
])
def test_right_is_a_matter_of_millimetres_or_of_coarse_pixels(mean_mm, tip_mm, px_mm, right):
    assert found(mean_mm, tip_mm, px_m=px_mm / 1000).right == right


def test_a_refusal_is_not_right_and_old_limits_stay():
    assert not REFUSED.right
    assert found(0.4, 1.2, px_m=0.4e-3).right and not found(0.4, 1.2, px_m=0.4e-3).within


def test_pixels_are_those_at_the_device():
    """At the isocentre 1 mm, 81 cm from the source; 81 mm towards source a a tenth less for plane a,
    and the same for b."""
    scene = drawn(0)
    towards_a = -SMALL[0].P[2, :3] * 0.081
    assert_allclose(trial.pixel_size(replace(scene, truth=np.zeros((3, 3)))), 1e-3)
    assert_allclose(trial.pixel_size(replace(scene, truth=np.tile(towards_a, (2, 1)))), 0.95e-3)
    assert math.isnan(trial.pixel_size(replace(scene, truth=np.empty((0, 3)))))


GIVEN = [found(0.1, 0.1, kind='rod', cpu_s=0.1, surprise=1.0), found(0.1, 2.5, kind='tube', cpu_s=0.3, surprise=9.0),
         found(0.5, 0.5, kind='rod', cpu_s=0.2), replace(REFUSED, kind='rod'), replace(REFUSED, kind='tube', cpu_s=0.9),
         Answer(0, Outcome.NO_DEVICE_A, False, kind='tube', cpu_s=0.6)]
TRIALS = [Trial(Task('devices', 3 + k, ('spline',)), {'spline': a}, None) for k, a in enumerate(GIVEN)]


def test_row_counts():
    r = variety.row(GIVEN)
    assert (r.scenes, r.shown, r.answered, r.right, r.silent, r.reported, r.honest) == (6, 5, 3, 1, 1, 2, 1)
    assert (r.cpu_answered, r.cpu_refused) == (variety.Cost(0.2, 0.3), variety.Cost(0.6, 0.9))
    assert list(r.rejections.items()) == [('length_out_of_bounds', 2), ('no_device_in_plane_a', 1)]
    assert variety.row(GIVEN[:3]).cpu_refused is None


def test_table_has_kinds_below_their_family():
    other = Trial(Task('wide', 0, ('spline',)), {'spline': found(0.1, 0.1, cpu_s=0.4)}, None)
    lines = variety.table([*TRIALS, other]).splitlines()
    assert max(map(len, lines)) < 140
    assert (lines[2].split() == 'devices spline 6 50 % 20 % 1 50 % 0.20 0.30 0.60 0.90 2 length_out_of_bounds, '
                                '1 no_device_in_plane_a'.split())
    assert lines[3].split() == 'rod 3 67 % 33 % 0 100 % 0.15 0.20 0.50 0.50 1 length_out_of_bounds'.split()
    assert (lines[4].split() == 'tube 3 33 % 0 % 1 0 % 0.30 0.30 0.75 0.90 1 length_out_of_bounds, '
                                '1 no_device_in_plane_a'.split())
    assert lines[5].split() == 'wide spline 1 100 % 100 % 0 - 0.40 0.40 - -'.split()
    assert (lines[-1] == 'spline: 2 of 6 devices right (33 %), 1 silent failures in 7 scenes (14.3 %), '
                         'CPU 0.40 s a pair, 0.90 s at worst')
    columns = [line.index('rod') for line in lines if 'rod' in line]
    assert columns == [2] and lines[2].startswith('devices')


def test_every_method_has_lines_of_its_own():
    both = Trial(Task('wide', 0, ('spline', 'paper')), {'spline': found(0.1, 0.1, cpu_s=0.4), 'paper': REFUSED}, None)
    lines = [line.split() for line in variety.table([both]).splitlines()]
    assert [lines[2][:3], lines[3][:2]] == [['wide', 'spline', '1'], ['paper', '1']]
    assert [line[0] for line in lines[-2:]] == ['spline:', 'paper:']


def test_trials_are_plain_for_json():
    plain = variety.plain_trial(TRIALS[1])
    assert ((plain['family'], plain['seed'], plain['kind'], plain['device'], plain['px_m'])
            == ('devices', 4, 'tube', True, None))
    answer = plain['answers']['spline']
    assert ((answer['outcome'], answer['right'], answer['silent_failure'], answer['cpu_s'], answer['surprise'])
            == ('ok', False, True, 0.3, 9.0))
    assert_allclose(answer['errors_m']['tip'], 2.5e-3)
    assert answer['confidence'] is None
    sure = Trial(TRIALS[1].task, {'spline': replace(GIVEN[1], confidence=0.998)}, None)
    assert (variety.plain_trial(sure)['answers']['spline']['confidence'] == 0.998
            and variety.plain([sure]) == variety.plain(TRIALS[1:2]))
    assert json.loads(json.dumps(variety.plain(TRIALS), allow_nan=False))['devices/spline/rod']['scenes'] == 3


# ---- what is tried


class Canned:
    """Stands in for the pipeline: keeps what it is given."""

    def __call__(self, frame, config, prior):
        self.config = config
        return Reconstruction(Outcome.LENGTH, 'too long', confidence=0.25)


@pytest.fixture
def pipeline(monkeypatch):
    canned = Canned()
    monkeypatch.setattr(trial, 'reconstruct', canned)
    return canned


def test_radius_is_given_off_and_the_base_kept_back(pipeline):
    case = Case(drawn(0), kind='rod')
    answer = trial.answer(case, Config(), radius_error=0.25)
    assert_allclose(pipeline.config.detection.robot_radius, 1.25e-3)
    assert_allclose(pipeline.config.curve.base_position, case.scene.truth[0])
    assert (answer.kind, answer.cpu_s >= 0, answer.confidence) == ('rod', True, 0.25)
    trial.answer(case, Config(), base=False)
    assert pipeline.config.curve.base_position == ()


@pytest.mark.parametrize('of_family, of_case, device', [(True, True, True), (True, False, False), (False, True, False)])
def test_a_case_without_a_device_is_one_and_so_are_all_of_a_family_without(monkeypatch, pipeline, of_family,
                                                                           of_case, device):
    family = Family('', lambda seed: Case(drawn(seed), device=of_case), device=of_family)
    monkeypatch.setattr(trial, 'varied', lambda sources: {'some': family})
    assert trial.attempt(Task('some', 0, ('spline',), sources=families.Sources())).answers['spline'].device == device


@pytest.mark.parametrize('wanted, outcome, taken', [
    ('', Outcome.OK, False), ('all', Outcome.LENGTH, True), ('refused', Outcome.LENGTH, True),
    ('refused', Outcome.OK, False), ('answered', Outcome.OK, True), ('answered', Outcome.LENGTH, False),
    ('silent', Outcome.OK, True), ('silent', Outcome.LENGTH, False),
])
def test_pictures_are_taken_of_what_is_asked_for(monkeypatch, wanted, outcome, taken):
    family = Family('', lambda seed: Case(drawn(seed)), device=False)       # so that what is published is wrong
    monkeypatch.setattr(trial, 'varied', lambda sources: {'some': family})
    monkeypatch.setattr(trial, 'answer', lambda *_: Answer(0, outcome, device=False))
    picture = trial.attempt(Task('some', 0, ('spline',), sources=families.Sources(), picture=wanted)).thumbnail
    assert (picture is not None) == taken


def test_what_cannot_be_drawn_or_given_is_named(monkeypatch, capsys):
    def make(seed):
        if seed == 1:
            raise ValueError('no such shape')
        if seed == 2:
            raise ImportError('no renderer')
        return Case(replace(drawn(0), radius=0.019))
    monkeypatch.setattr(trial, 'varied', lambda sources: {'some': Family('', make)})
    for seed, error, words in ((1, 0.0, 'some, seed 1: no such shape'), (2, 0.0, 'some, seed 2: no renderer'),
                               (0, 0.5, 'some, seed 0: robot_radius')):
        with pytest.raises(ToolError, match=words):
            trial.attempt(Task('some', seed, ('spline',), sources=families.Sources(), radius_error=error))
    # what cannot be drawn is left out; what is wrong with all of them ends the bench
    assert trial.attempt_or_skip(Task('some', 1, ('spline',), sources=families.Sources())) is None
    assert capsys.readouterr().err == 'left out: some, seed 1: no such shape\n'
    with pytest.raises(ToolError):
        trial.attempt_or_skip(Task('some', 2, ('spline',), sources=families.Sources()))


def test_counted_families_are_tried_from_their_first_scene():
    assert variety.seeds(Family('', None), 7, 3) == range(7, 10)
    assert [variety.seeds(Family('', None, count=5), 7, n) for n in (3, 9)] == [range(3), range(5)]


# ---- scenes from elsewhere


def test_scenes_from_elsewhere_are_read_in_order_of_name(folder):
    family = open_scenes.open_family(folder)
    cases = [family.make(seed) for seed in range(family.count)]
    assert [(c.note, c.kind, c.device) for c in cases] == [('none_0', 'none', False),
                                                           *((f'rod_{k}', 'rod', True) for k in range(3))]
    blank, rod, original = cases[0].scene, cases[2].scene, drawn(1)
    assert blank.truth.shape == (0, 3) and blank.base_position.tolist() == []
    for read, image, view, expected in zip(rod.frame.images, original.frame.images, rod.frame.views,
                                           original.frame.views):
        np.testing.assert_array_equal(read, image)
        assert_allclose(view.P, expected.P)
        assert (view.width, view.height) == (320, 320)
    assert_allclose(rod.truth, original.truth)
    assert_allclose(rod.base_position, original.truth[0])
    assert rod.radius == 0.001


def test_sixteen_bits_and_unequal_planes_stay_what_they_are(tmp_path):
    scene = drawn(0)
    images = (scene.frame.images[0].astype(np.uint16) * 200, scene.frame.images[1][:300, :250])
    save(tmp_path / 'one', replace(scene, frame=replace(scene.frame, images=images)))
    frame = open_scenes.open_case(tmp_path / 'one').scene.frame
    assert [image.dtype for image in frame.images] == [np.uint16, np.uint8] and frame.images[0].max() > 30000
    assert [(v.width, v.height) for v in frame.views] == [(320, 320), (250, 300)]


def test_without_a_truth_no_base_is_given(folder, pipeline):
    answer = trial.answer(open_scenes.open_case(folder / 'none_0'), Config())
    assert pipeline.config.curve.base_position == () and not answer.device and math.isnan(answer.px_m)


@pytest.mark.parametrize('changes, words', [
    ({'P_b': None}, 'P_b is missing'), ({'P_a': [[1, 2], [3, 4]]}, 'not 3x4'),
    ({'P_a': 'wide'}, 'P_a is not made of finite numbers'), ({'P_a': [[0, 0, 0, 0]] * 3}, 'zero or singular'),
    ({'P_b': [[1, 2], [3]]}, 'P_b is not'), ({'radius_m': -1}, 'radius_m is -1'), ({'radius_m': [1, 2]}, 'radius_m'),
    ({'radius_m': math.nan}, 'radius_m'), ({'backbone_m': []}, 'less than two points'),
    ({'backbone_m': [[1, 2]]}, 'backbone_m must be N x 3, got 1 x 2'), ({'backbone_m': 3}, 'backbone_m must be N x 3'),
    ({'backbone_m': [[0, 0, math.inf], [0, 0, 1]]}, 'backbone_m is not made of finite'),
    ({'device': 'yes'}, 'device must be'), ({'family': None}, 'family is missing'),
])
def test_a_bad_description_is_named(tmp_path, changes, words):
    save(tmp_path / 'one', drawn(0), **changes)
    with pytest.raises(ToolError) as error:
        open_scenes.open_case(tmp_path / 'one')
    assert (str(tmp_path / 'one' / 'scene.json') in str(error.value) and words in str(error.value)
            and '\n' not in str(error.value))


@pytest.mark.parametrize('text', ['', '{"P_a": ', '[]', '7', 'null', '\x00', '"text"'])
def test_what_is_no_description_is_named(tmp_path, text):
    save(tmp_path / 'one', drawn(0))
    (tmp_path / 'one' / 'scene.json').write_text(text)
    with pytest.raises(ToolError, match='scene.json'):
        open_scenes.open_case(tmp_path / 'one')


def test_bad_folders_and_images_are_named(tmp_path):
    with pytest.raises(ToolError, match='nowhere: there is no such folder'):
        open_scenes.open_family(tmp_path / 'nowhere')
    with pytest.raises(ToolError, match='no folders of scenes'):
        open_scenes.open_family(tmp_path)
    save(tmp_path / 'one', drawn(0))
    file = tmp_path / 'one' / 'plane_b.png'
    for image in (np.zeros((20, 20, 3), np.uint8), None):
        cv2.imwrite(str(file), image) if image is not None else file.write_text('no image')
        with pytest.raises(ToolError, match='plane_b.png'):
            open_scenes.open_case(tmp_path / 'one')
    file.unlink()
    with pytest.raises(ToolError, match='plane_b.png: there is no such file'):
        open_scenes.open_family(tmp_path)


# ---- sheets


def test_a_thumbnail_is_stretched_between_its_percentiles():
    """A ramp of 1000 columns from 2000 to 2999, at 0.4 of its size: black to the 0.5th percentile, 2005, and white from
    the 99.5th, 2994."""
    ramp = np.tile(np.arange(2000, 3000, dtype=np.uint16), (500, 1))
    pair = sheets.thumbnail((ramp, np.full((800, 800), 7, np.uint8)))
    assert pair.shape == (400, 804) and pair.dtype == np.uint8
    left, right = pair[:, :400], pair[:, 404:]
    assert not left[:100].any() and not left[300:].any() and not right.any()    # half as high as wide; flat is black
    low, high = 2000 + 0.005 * 999, 2000 + 0.995 * 999
    assert_allclose(left[200], np.clip((2000.75 + 2.5 * np.arange(400) - low) / (high - low) * 255, 0, 255), atol=1.0)
    assert (left[200, 0], left[200, -1]) == (0, 255)


def cell(value=200, note='', colour='#ff0000'):
    return sheets.Cell(np.full((400, 804), value, np.uint8), 'wide 7', note, 'refused', colour)


def test_a_sheet_shows_pairs_as_they_are_with_a_line_below():
    shown = sheets.sheet([cell(k) for k in (10, 20, 30)])
    assert shown.shape == (2 * 442, 2 * 824, 3)
    for k, (top, left) in enumerate([(10, 10), (10, 834), (452, 10)]):
        assert (shown[top:top + 400, left:left + 804] == 10 * (k + 1)).all()
        line = shown[top + 400:top + 422, left:left + 804]
        assert line[..., 2].max() > 200 and not line[..., :2].any()      # red
    assert not shown[442:, 824:].any()


def test_a_long_note_is_cut_and_what_matters_stays():
    assert sheets.caption(cell(note='a note')) == 'wide 7  a note  refused'
    assert sheets.caption(cell()) == 'wide 7  refused'
    line = sheets.caption(cell(note='much to say ' * 40))
    assert line.startswith('wide 7  much to say') and line.endswith('...  refused')
    assert 700 < cv2.getTextSize(line, **sheets.FONT)[0][0] <= 804
    assert sheets.caption(cell(note='µm')) == 'wide 7  ?m  refused'


def test_sheets_hold_ten_and_old_ones_go(tmp_path):
    for name in ('wide_4.png', 'wide_anatomy_0.png'):
        (tmp_path / name).touch()
    files = sheets.write(tmp_path, 'wide', [cell()] * 11)
    assert [f.name for f in files] == ['wide_0.png', 'wide_1.png']
    assert [cv2.imread(str(f)).shape[0] for f in files] == [5 * 442, 442]
    assert sorted(f.name for f in tmp_path.iterdir()) == ['wide_0.png', 'wide_1.png', 'wide_anatomy_0.png']


def test_verdicts():
    said = [variety.verdict(a) for a in (found(0.1, 0.1), found(0.5, 0.5), found(5, 5), REFUSED,
                                         Answer(0, Outcome.OK, False), replace(REFUSED, device=False))]
    assert said == ['right', 'published, not right', 'SILENT', 'refused: length_out_of_bounds', 'no device, SILENT',
                    'no device, refused: length_out_of_bounds']


def test_only_the_first_pictures_of_a_family_are_kept():
    picture = np.zeros((4, 4), np.uint8)
    trials = [Trial(Task(name, k, ('spline',)), {'spline': REFUSED}, None, picture if k != 1 else None)
              for name in ('a', 'b') for k in range(5)]
    kept = list(variety.fewer_pictures(trials, 2))
    assert [(t.task.family, t.task.seed) for t in kept if t.thumbnail is not None] == [('a', 0), ('a', 2),
                                                                                       ('b', 0), ('b', 2)]
    assert [t.task for t in kept] == [t.task for t in trials]


# ---- the command


def test_command_prints_writes_and_draws(folder, tmp_path, capsys):
    file, out = tmp_path / 'v.json', tmp_path / 'sheets' / 'new'
    assert main.main(['variety', '--families', 'open', '--open', str(folder), '--first-seed', '60', '--min-confidence',
                      '0.5', '--json', str(file), '--pictures', '1',
                      '--pictures-of', 'answered', '--sheets', str(out)]) == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines()]
    assert [line[0] for line in lines[2:5]] == ['open', 'none', 'rod']
    assert lines[3][1:7] == '1 0 % - 0 -'.split() and lines[4][1:7] == '3 67 % 67 % 0'.split()
    content = json.loads(file.read_text())
    assert ([(t['family'], t['seed'], t['kind'], t['note']) for t in content['trials']]
            == [('open', 0, 'none', 'none_0'), *(('open', 1 + k, 'rod', f'rod_{k}') for k in range(3))])
    assert [t['answers']['spline']['right'] for t in content['trials']] == [False, True, True, False]
    assert all(0 < t['answers']['spline']['cpu_s'] < 60 for t in content['trials'])
    assert content['trials'][0]['px_m'] is None and content['trials'][1]['px_m'] == pytest.approx(1e-3, rel=0.01)
    assert content['rows']['open/spline']['cpu_answered']['worst'] == max(t['answers']['spline']['cpu_s']
                                                                          for t in content['trials'][1:3])
    shown = cv2.imread(str(out / 'open_0.png'))[10:410, 10:814, 0]
    np.testing.assert_array_equal(shown, sheets.thumbnail(drawn(0).frame.images))     # the first that was answered
    assert [f.name for f in out.iterdir()] == ['open_0.png']


@pytest.mark.parametrize('arguments, code, word', [
    (['--families', 'nosuch'], 2, 'nosuch'),
    (['--families', 'wide', 'anatomy'], 2, 'no such family: anatomy'),
    (['--families', 'ct_none'], 2, 'ct_none needs --ct FILE'),
    (['--families', 'open'], 2, 'open needs --open DIR'),
    (['--first-seed', '-1'], 2, '--first-seed'),
    (['--jobs', '3', '--scheduler', 'here:1'], 2, '--scheduler'),
    (['--radius-error', '-1'], 2, '--radius-error'),
    (['--radius-error', 'nan'], 2, '--radius-error'),
    (['--pictures-of', 'cats'], 2, 'cats'),
    (['--ct', '/no/such/ct.npz'], 1, '/no/such/ct.npz'),
    (['--open', '/no/such/folder'], 1, '/no/such/folder'),
    (['--json', '/no/such/folder/v.json'], 1, 'no such folder'),
    (['--pictures', '1', '--sheets', '/dev/null/sheets'], 1, '/dev/null'),
])
def test_what_cannot_be_benched_is_named_at_once(arguments, code, word, capsys):
    try:
        assert main.main(['variety', *arguments]) == code
    except SystemExit as stop:
        assert stop.code == code
    error = capsys.readouterr().err.splitlines()
    assert word in error[-1] and (code == 2 or len(error) == 1)


def test_a_broken_scene_ends_the_run_in_one_line(folder, capfd):
    (folder / 'rod_0' / 'scene.json').write_text('{}')
    assert main.main(['variety', '--families', 'open', '--open', str(folder), '--jobs', '1']) == 1
    assert 'rod_0/scene.json: backbone_m is missing' in capfd.readouterr().err.splitlines()[-1]


def test_help_names_all_families():
    text = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.bench.main', 'variety', '--help'],
                          capture_output=True, text=True, check=True).stdout
    assert set(families.varied()) < set(variety.texts())
    assert all(f'\n  {name} ' in text for name in variety.texts())
