"""Whether the calibrations of both planes belong together: places that both planes see against one another's epipolar
lines."""

import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from drawing import BASE, CALIBRATIONS, GOOD, SIZE, VIEWS

from fluoro_shape_ros.bench.calibration_watch import ERRORS, Watched, misplaced, report, views_with
from fluoro_shape_ros.data import Landmarks
from fluoro_shape_ros.geometry.cameras import make_view, project
from fluoro_shape_ros.ros.calibration_watch import WRONG, CalibrationWatch, Finding, observed

# 1 px is 1 mm at the isocentre, v runs along the common axis
A, B = (make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS))
NOISE_PX = 0.3
TURN = np.deg2rad(2)
NUMBER = re.compile(r'(\d+\.\d)')
SEES_IT = 1.5           # px, that plane B of the drawn pairs is off by


def seen(X, kinds, rng=None, bias=(0.0, 0.0)):
    """What the true planes show of (N, 3) points, of a device that runs along v: its ends, known to NOISE_PX along it
    and off by a `bias` in plane B."""
    along = np.array([[0.0, -1.0 if kind == 'tip' else 1.0] for kind in kinds]).reshape(-1, 2)
    off = (np.array([bias[int(kind == 'base')] for kind in kinds])
           + (0.0 if rng is None else rng.normal(0, NOISE_PX, len(kinds))))
    return Landmarks(kinds, project(A.P, X), project(B.P, X) + along * off[:, None], NOISE_PX * along)


def result(landmarks, confidence=0.999):
    return SimpleNamespace(landmarks=landmarks, confidence=confidence)


def run(views, pairs, seed=0, wrong=0.0, bias=0.0, watch=None, cameras=None):
    """What is found over so many pairs of a device whose ends wander about; some share of the ends was found at a wrong
    place."""
    watch, rng = watch or CalibrationWatch(), np.random.default_rng(seed)
    biases, phase, pace = rng.normal(0, bias, 2), rng.uniform(0, 6, (2, 3)), rng.uniform(0.05, 0.15, (2, 3))
    for k in range(pairs):
        X = 0.05 * np.sin(phase + pace * k) + [[0, 0, 0.04], [0, 0, -0.04]]
        places = seen(X, ('tip', 'base'), rng, biases)
        astray = (rng.uniform(size=2) < wrong)[:, None] * rng.uniform(-20, 20, (2, 2))
        watch.take(result(Landmarks(places.kinds, places.a_px, places.b_px + astray, places.slack_px)), views, cameras)
    return watch.finding


def apart(X, views):
    return observed(seen(np.atleast_2d(X), ('tip',)), views)[0, 0]


def test_a_shift_is_the_distance_from_the_epipolar_line():
    middle = [0.0, 0.0, 0.0]    # whose epipolar lines run along u
    assert apart(middle, (A, B)) == pytest.approx(0, abs=1e-9)
    assert abs(apart(middle, (A, misplaced(B, (0, 1.5))))) == pytest.approx(1.5)
    assert abs(apart(middle, (misplaced(A, (0, 1.5)), B))) == pytest.approx(1.5, abs=1e-4)
    assert apart(middle, (A, misplaced(B, (1.5, 0)))) == pytest.approx(0, abs=1e-9)      # it only moves in depth
    assert apart([0.02, -0.01, 0.03], (B, A)) != pytest.approx(0, abs=0.1)


@pytest.mark.parametrize('X', [[0.03, 0.0, 0.0], [0.02, -0.04, 0.05], [-0.05, 0.03, -0.06]])
@pytest.mark.parametrize('k, small, views', [
    (0, 1e-3, lambda d: (A, misplaced(B, (0, d)))),
    (1, 1e-5, lambda d: (misplaced(A, turn=d), B)),
    (2, 1e-5, lambda d: (A, misplaced(B, turn=d))),
    (3, 1e-5, lambda d: (A, misplaced(B, scale=1 + d))),
])
def test_each_error_acts_as_its_column_says(X, k, small, views):
    row = observed(seen(np.array([X]), ('tip',)), (A, B))[0]
    by = -apart(X, views(small)) / small        # the line moves, and not what is seen
    assert (by if k else abs(by)) == pytest.approx(row[2 + k], rel=0.01, abs=0.1)


@pytest.mark.parametrize('views, words', [
    ((A, misplaced(B, (0, 1.5))), 'as if one were shifted by 1.5 px'),
    ((A, misplaced(B, turn=TURN)), 'as if plane B were turned by 2.0 degrees'),
    ((misplaced(A, turn=TURN), B), 'as if plane A were turned by 2.0 degrees'),
    ((A, misplaced(B, scale=1.02)), 'as if one were 2.0 % too large'),
    ((B, A), 'and would agree if the calibrations were exchanged'),
])
def test_what_is_wrong_is_noticed_measured_and_named(views, words):
    found = run(views, 60)
    expected, told = (NUMBER.split(text) for text in (words, found.looks_like))
    assert (found.noticed and told[::2] == expected[::2]
            and all(abs(float(t) - float(e)) < 0.4 for t, e in zip(told[1::2], expected[1::2])))
    assert str(found).startswith(f'the planes disagree by {found.apart_px:.1f} px +- 0.')
    assert str(found).endswith(f' across the epipolar lines over 60 pairs, {found.looks_like}: check the calibration')


def test_a_shift_is_measured_as_well_as_it_says():
    found = [run((A, misplaced(B, (0, 1.5))), 60, seed) for seed in range(8)]
    assert all(abs(f.apart_px - 1.5) < 3 * f.sigma_px < 0.75 for f in found)


def test_right_calibrations_are_not_cried_about():
    found = [run((A, B), 100, seed, bias=0.5 * NOISE_PX, wrong=0.05) for seed in range(12)]
    assert not any(f.noticed for f in found) and all(f.pairs == 100 and 'nothing noticed' in str(f) for f in found)
    assert np.median([f.apart_px for f in found]) < 0.2
    # with the same that is astray
    assert run((A, misplaced(B, (0, 1.0))), 100, bias=0.5 * NOISE_PX, wrong=0.05).noticed


def test_a_shift_along_the_epipolar_lines_shows_nothing():
    flat = [(A, misplaced(B, (px, 0))) for px in (0.0, 0.5)]
    assert not any(run(views, 60).noticed for views in flat)


def test_nothing_is_said_before_there_is_evidence():
    watch = CalibrationWatch()
    assert str(watch.finding) == 'too little seen yet to tell (0 pairs)'
    run((A, misplaced(B, (0, 3.0))), 4, watch=watch)
    assert watch.finding == Finding(4)
    assert run((A, misplaced(B, (0, 3.0))), 30, seed=1, watch=watch).noticed


def test_it_begins_anew_where_it_is_told_to_and_with_another_camera():
    watch, wrong = CalibrationWatch(), (A, misplaced(B, (0, 2.0)))
    assert run(wrong, 40, watch=watch, cameras='first').noticed
    watch.reset()
    assert watch.finding == Finding()
    assert run(wrong, 40, watch=watch, cameras='first').noticed
    assert run((A, B), 1, watch=watch, cameras='second') == Finding(1)
    assert not run((A, B), 60, watch=watch, cameras='second').noticed


def test_it_recovers_when_the_planes_agree_again():
    watch = CalibrationWatch()
    assert run((A, misplaced(B, (0, 1.0))), 40, watch=watch).noticed
    assert not run((A, B), 1000, seed=1, watch=watch).noticed


@pytest.mark.parametrize('given', [result(None), result(seen(np.zeros((0, 3)), ())),
                                   result(seen(np.zeros((1, 3)), ('tip',)), 0.2),
                                   result(seen(np.zeros((1, 3)), ('tip',)), float('nan'))])
def test_pairs_without_landmarks_and_curves_that_are_rather_wrong_do_not_count(given):
    watch = CalibrationWatch()
    watch.take(given, (A, B), None)
    assert watch.finding == Finding()


def test_errors_of_the_bench_are_what_they_are_called():
    assert set(WRONG) == {'shifted', 'turned a', 'turned b', 'scaled'}
    X = np.array([[0.01, 0.02, 0.03]])
    (u, v), middle = project(B.P, X)[0], (SIZE - 1) / 2
    px = {error: project(views_with(error, (A, B))[1].P, X)[0] for error in ERRORS}
    np.testing.assert_allclose(px['none'], (u, v))
    np.testing.assert_allclose(px['shifted along v by 2 px'], (u, v + 2))
    np.testing.assert_allclose(px['shifted along u by 0.5 px'], (u + 0.5, v))
    np.testing.assert_allclose(px['scaled by 2 %'] - middle, 1.02 * np.array([u - middle, v - middle]))
    c, s = np.cos(TURN), np.sin(TURN)
    np.testing.assert_allclose(px['turned by 2 degrees'] - middle,
                               [c * (u - middle) - s * (v - middle), s * (u - middle) + c * (v - middle)])
    np.testing.assert_allclose(px['exchanged'], project(A.P, X)[0])


def test_the_table_of_the_bench():
    exchanged = Finding(24, True, 3.0, 0.3, 'and would agree if the calibrations were exchanged')
    runs = [[Watched('none', 24, None, Finding(24)), Watched('exchanged', answered, after, exchanged)]
            for answered, after in ((24, 5), (12, 15))]
    _, right, wrong, *_ = report(runs, 24).splitlines()
    assert right.split() == ['none', '0', 'of', '2', '100', '%']
    assert wrong.split() == ['exchanged', '2', 'of', '2', '10', '75', '%', '3.0', '2', 'exchanged']


# ---- where people see it


def test_a_replay_says_it_in_the_terminal_and_for_programs(tmp_path, capsys, monkeypatch):
    pytest.importorskip('rosbags')
    import recording
    spoiled = [CALIBRATIONS[0], dataclasses.replace(CALIBRATIONS[1], P=misplaced(B, (0, SEES_IT)).P)]
    for name, calibrations, noticed in (('right', CALIBRATIONS, False), ('wrong', spoiled, True)):
        monkeypatch.setattr(recording, 'CALIBRATIONS', calibrations)
        recording.record(tmp_path / name, [GOOD] * 12)
        assert recording.main(tmp_path / name, '--out', tmp_path / f'{name}_out', '--json', tmp_path / f'{name}.json',
                              '-p', BASE, '-p', 'reference_frame=cell') == 0
        said = json.loads((tmp_path / f'{name}.json').read_text())['calibration_watch']
        assert (said['noticed'] is noticed and said['pairs'] == 12
                and f'calibration watch: {said["words"]}\n' in capsys.readouterr().out)
    assert (said['apart_px'] == pytest.approx(SEES_IT, abs=0.3)
            and said['looks_like'].startswith('as if one were shifted'))


def test_the_node_says_it_in_diagnostics_and_forgets_it_when_reset(tmp_path_factory):
    pytest.importorskip('rclpy')
    import ros_client as ros
    wrong = [ros.VIEWS[0], misplaced(make_view('b', ros.VIEWS[1], ros.SIZE, ros.SIZE), (0, SEES_IT)).P]
    with ros.answered(tmp_path_factory, ros.BASE, ros.RADIUS, 'reference_frame:=cell') as (node, client):
        assert client.value('reconstruction', 'calibration_watch').startswith('too little seen yet to tell')
        said = lambda: any('the planes disagree by' in s.message and s.level == b'\x01'    # noqa: E731
                           for s in client.statuses)
        assert client.insist(said, every=0.5, infos=[ros.info_msg(P) for P in wrong]), node.log
        assert client.value('reconstruction', 'calibration_watch').startswith('the planes disagree by')
        assert client.until(lambda: 'the planes disagree by' in node.log)
        assert client.trigger('reset').success
        assert client.value('reconstruction', 'calibration_watch') == 'too little seen yet to tell (0 pairs)'
        assert client.good() and client.hears('results/s')
