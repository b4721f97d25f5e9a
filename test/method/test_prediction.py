"""A prediction: which one counts, what it can be, and that it helps when right and does no harm when wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fluoro_shape_ros.bench import prediction
from fluoro_shape_ros.bench.families import families
from fluoro_shape_ros.bench.prediction import Try, predictions, pushed
from fluoro_shape_ros.bench.score import Answer, answer_of
from fluoro_shape_ros.config import Config, ConfigError
from fluoro_shape_ros.data import Outcome, Prior
from fluoro_shape_ros.geometry.spline import Spline3
from fluoro_shape_ros.method import prediction as prior
from fluoro_shape_ros.method import search
from fluoro_shape_ros.method.fit.result import Fit
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.xray import Exposure

SECOND = 10**9
VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
LINE = np.c_[np.linspace(-0.05, 0.05, 101), np.zeros((101, 2))]     # 100 mm along x, through the isocentre
SIGMA = Config().curve.prior_sigma


def look(points, fault='', sigma=SIGMA):
    return prior.look(Prior(predicted=points, prediction_fault=fault), VIEWS, sigma)


# ---- by hand


def test_the_newest_that_is_not_younger_than_the_pair_counts():
    given = [SimpleNamespace(stamp_ns=t) for t in (10, 30, 20)]
    assert [prior.newest(given, t) for t in (9, 10, 25, 99)] == [None, given[0], given[2], given[1]]
    assert prior.newest([], 5) is None


def test_a_prediction_gets_stale():
    assert prior.staleness(SECOND, SECOND, 0.5) == '' == prior.staleness(SECOND, 3 * SECOND // 2, 0.5)
    assert prior.staleness(SECOND, 16 * SECOND // 10, 0.5) == 'it is 0.60 s older than the pair, prior_max_age is 0.5 s'
    assert prior.staleness(0, SECOND, 60.0) == 'it has no stamp'


@pytest.mark.parametrize('points, why', [
    (LINE[:1], 'fewer than two points'),
    (np.where(LINE == LINE[3], np.nan, LINE), 'not finite'),
    (LINE / 50, 'its length is 2 mm'),
    (LINE * 50, 'its length is 5000 mm'),
    (LINE + [0, 0, 0.5], 'outside plane a'),
    (LINE + [0, -2.0, 0], 'outside plane'),
])
def test_what_can_be_no_prediction_is_named(points, why):
    guess, said = look(points)
    assert guess is None and why in said


def test_its_standard_deviation_grows_from_base_to_tip():
    guess, why = look(LINE)
    assert why == '' and look(None) == (None, '') and look(LINE, 'it is stale') == (None, 'it is stale')
    assert_allclose(guess.sigma[[0, 50, 100]], [1e-3, 5.5e-3, 10e-3])
    assert_allclose(look(LINE, sigma=0.5e-3)[0].sigma, 0.5e-3)


@pytest.mark.parametrize('found, why', [
    (LINE, ''),
    (LINE[40:], ''),                                                        # its base is out of sight
    (LINE + [0, 2.9e-3, 0], ''),
    (LINE + [0, 3.1e-3, 0], 'device 3.1 mm from there'),                    # three times the base's 1 mm
    (pushed(LINE, 0.015, np.random.default_rng(0)), ''),
    (LINE[:65], 'tip 36.0 mm from there'),
    (LINE[::-1], 'the other way round'),
])
def test_doubt_by_hand(found, why):
    said = prior.doubt(found, look(LINE)[0])
    assert said.endswith(why) and bool(said) == bool(why)


def test_a_prediction_of_either_direction_is_borne_out_by_its_curve():
    guess, _ = look(LINE)
    assert (prior.borne_out(LINE, guess) and prior.borne_out(LINE[::-1], guess)
            and not prior.borne_out(LINE + [0, 0.02, 0], guess))
    assert (prior.whole(0.1, guess, VIEWS) and not prior.whole(0.06, guess, VIEWS)
            and not prior.whole(0.14, guess, VIEWS))


def test_in_a_fit_it_counts_by_its_standard_deviation_and_only_across_the_curve():
    # along x; the images know z to 0.01 mm, but y, the same all along, only to 5 mm. Five independent points say y = 2
    # mm, z = 2 mm, each to 5 mm
    n, mm = 9, 1e-3
    control = np.c_[np.linspace(-0.05 - 0.1 / 6, 0.05 + 0.1 / 6, n), np.zeros((n, 2))]
    covariance = np.zeros((n, 3, n, 3))
    covariance[:, 1, :, 1] = (5 * mm) ** 2
    covariance[np.arange(n), 2, np.arange(n), 2] = (0.01 * mm) ** 2
    f = Fit(Spline3(0.0, 0.1, control), 0.0, 0.1, *[None] * 2, covariance.reshape(3 * n, 3 * n), *[None] * 9)
    told = prior.informed(f, prior.Guess(LINE + [0.3 * mm, 2 * mm, 2 * mm], np.full(len(LINE), 5 * mm)))
    points = told.spline(np.linspace(0, 0.1, 21))
    assert_allclose(points[:, 0], np.linspace(-0.05, 0.05, 21), atol=1e-6)      # it does not slide along itself
    # 5 / 25 of the points against 1 / 25 of the images
    assert_allclose(points[:, 1], 2 * mm * 5 / 6, atol=1e-6)
    assert_allclose(points[:, 2], 0, atol=1e-6)
    assert_allclose(np.sqrt(told.covariance.reshape(n, 3, n, 3)[4, 1, 4, 1]), 5 * mm / np.sqrt(6), rtol=1e-3)


def test_a_pushed_tip_is_as_far_as_it_says():
    bent = pushed(LINE, 0.012, np.random.default_rng(3))
    assert np.linalg.norm(bent[-1] - LINE[-1]) == pytest.approx(0.012, rel=0.02)
    assert_array_equal(bent[0], LINE[0])


@pytest.mark.parametrize('values', [dict(prior_sigma=0.0), dict(prior_sigma=-0.01), dict(prior_max_age=-1.0)])
def test_unusable_parameters_are_refused(values):
    with pytest.raises(ConfigError):
        Config.from_values(**values)


def test_the_bench_counts_by_hand():
    good = Answer(0, Outcome.OK, errors=Errors(0.1e-3, 0, 0, 0.2e-3, 0, 0))
    without = [Try(good, 0.2, 0.0, ''), Try(Answer(1, Outcome.NO_DEVICE_A), 0.2, 0.0, '')]
    done = [Try(good, 0.1, 0.01e-3, 'agrees'), Try(good, 0.05, float('nan'), 'ignored: it is stale')]
    line = prediction._line('clutter', 'good', done, without).split()
    assert line == 'clutter good 2 of 2 2 0 0.100 0.200 3.00 1 of 2 0.010 1 agrees, 1 ignored'.split()


# ---- on images


@pytest.fixture(scope='module')
def scene():
    return xray_run(0, views=VIEWS, lengths=(0.07, 0.08), anatomy=False).scene()


@pytest.fixture(scope='module')
def config(scene):
    return Config.from_values(base_position=scene.truth[0].tolist())


@pytest.fixture(scope='module')
def answer(scene, config):
    result = reconstruct(scene.frame, config)
    assert result.outcome is Outcome.OK and result.prediction == '' and not result.warnings
    return result


@pytest.fixture(scope='module')
def good(scene):
    """(N, 3) what a model says of a robot whose tip is pushed aside by 15 mm."""
    return pushed(scene.truth, 0.015, np.random.default_rng(1))[::20]


def test_a_pushed_robot_is_measured_where_it_is_without_a_search(scene, config, good):
    result = reconstruct(scene.frame, config, Prior(predicted=good))
    assert result.prediction == 'agrees' and not result.warnings
    assert 'follow' in result.stage_seconds and 'search' not in result.stage_seconds
    assert (np.linalg.norm(result.shape.tip - scene.truth[-1]) < 0.2e-3 < 0.01
            < np.linalg.norm(good[-1] - scene.truth[-1]))


def test_tracking_that_the_prediction_contradicts_gives_way_to_it(scene, config, answer, good, monkeypatch):
    """Say tracking held on to the first half of the device only, and that was believed."""
    import fluoro_shape_ros.method.pipeline as pipeline
    real, config = pipeline.tracked, config.replace(min_confidence=0.0)
    monkeypatch.setattr(pipeline.judge, 'STILL_THERE', 0.0)
    monkeypatch.setattr(pipeline.judge, 'BEYOND_DOUBT', 0.0)

    def half(*arguments):
        found = real(*arguments)
        return replace(found, fit=replace(found.fit, stop=(found.fit.start + found.fit.stop) / 2))
    monkeypatch.setattr(pipeline, 'tracked', half)
    lost = reconstruct(scene.frame, config, Prior(previous=answer.shape))
    assert lost.shape.length < 0.7 * answer.shape.length
    result = reconstruct(scene.frame, config, Prior(previous=answer.shape, predicted=good))
    assert result.prediction == 'agrees'
    assert_allclose(result.shape.tip, answer.shape.tip, atol=0.2e-3)


def test_it_orders_the_ends(scene):
    """With the tip hardly pushed, the images bear out either direction."""
    for points in (scene.truth[::20], scene.truth[::-20]):
        result = reconstruct(scene.frame, Config(), Prior(predicted=points))
        assert result.outcome is Outcome.OK and not result.warnings
        assert np.linalg.norm(result.shape.points[0] - points[0]) < np.linalg.norm(result.shape.points[-1] - points[0])


def test_the_previous_result_knows_the_ends_better(scene, answer):
    result = reconstruct(scene.frame, Config(), Prior(previous=answer.shape, predicted=scene.truth[::-20]))
    assert_allclose(result.shape.tip, answer.shape.tip, atol=0.1e-3)
    assert 'prediction_ignored: base and tip are the other way round' in result.warnings


@pytest.mark.parametrize('kind', ['of another hand', 'shifted', 'reversed', 'another'])
def test_a_wrong_one_is_named_and_changes_nothing(scene, config, answer, kind):
    wrong = scene.truth[::20] * [-1, 1, 1] if kind == 'of another hand' else predictions(scene.truth, 2)[kind]
    result = reconstruct(scene.frame, config, Prior(predicted=wrong))
    assert_allclose(result.shape.points, answer.shape.points, atol=0.02e-3)
    assert result.prediction.startswith('ignored: ') and result.warnings == (f'prediction_{result.prediction}',)


def test_a_wrong_one_does_not_order_the_ends(scene, good):
    result = reconstruct(scene.frame, Config(), Prior(predicted=good + [0.03, 0.03, 0.0]))
    assert result.warnings[0] == 'tip_ambiguous' and result.warnings[1].startswith('prediction_ignored')


def test_without_a_device_nothing_is_found_where_it_is_predicted(config, good):
    blank = xray_run(0, views=VIEWS, lengths=(0.07, 0.08), anatomy=False).without_device()
    result = reconstruct(blank, config, Prior(predicted=good))
    assert result.outcome is Outcome.NO_DEVICE_A and result.prediction == 'not compared'


@pytest.mark.parametrize('family, seed', [
    ('tangent', 10035),     # one step past the device's bend the curve leaves it in both planes at once, which looks
                            # like an end, 20 mm short of it
    ('clutter', 20037),     # the planes' views of an end move the curve by 4 px, after strips were last laid across it
    ('tangent', 10007),     # the same, in depth
])
def test_a_fit_near_a_prediction_has_to_come_to_rest_on_all_of_the_path(family, seed):
    case = families()[family].make(seed)
    config = Config.from_values(base_position=case.scene.base_position.tolist(), min_confidence=0.0)
    good = predictions(case.scene.truth, case.scene.seed)['good']
    assert answer_of(case, reconstruct(case.scene.frame, config, Prior(predicted=good))).within


@pytest.fixture(scope='module')
def faint():
    """A scene in which the images alone do not tell for sure."""
    return xray_run(0, views=VIEWS, lengths=(0.06, 0.08), anatomy=False, exposure=Exposure(photons=18.0)).scene()


def test_a_prediction_that_is_borne_out_speaks_for_a_faint_device_and_a_wrong_one_says_nothing(faint):
    given = predictions(faint.truth, 1)
    config = Config.from_values(base_position=faint.base_position.tolist())
    ask = lambda least, **kind: reconstruct(faint.frame, config.replace(min_confidence=least),    # noqa: E731
                                            Prior(**kind))
    without, known = ask(0.0), ask(0.0, predicted=given['good'])
    assert np.linalg.norm(known.shape.tip - faint.truth[-1]) < 1e-3 and known.prediction == 'agrees'
    assert known.confidence > without.confidence
    between = (known.confidence + without.confidence) / 2
    assert (ask(between).outcome is Outcome.LOW_CONFIDENCE
            and ask(between, predicted=given['good']).outcome is Outcome.OK)
    for kind in ('shifted', 'reversed', 'another'):
        wrong = ask(between, predicted=given[kind])
        assert wrong.outcome is Outcome.LOW_CONFIDENCE and wrong.prediction == 'not compared'
        assert wrong.confidence == pytest.approx(without.confidence, abs=0.01)


def test_where_no_line_is_seen_in_an_image_it_is_found_where_it_is_predicted(faint, monkeypatch):
    monkeypatch.setattr(search, 'candidates', lambda *_: ([], []))
    given = predictions(faint.truth, 1)
    config = Config.from_values(base_position=faint.base_position.tolist(), min_confidence=0.0)
    assert reconstruct(faint.frame, config).outcome is Outcome.NO_DEVICE_A
    found = reconstruct(faint.frame, config, Prior(predicted=given['good']))
    assert found.prediction == 'agrees' and np.linalg.norm(found.shape.tip - faint.truth[-1]) < 1e-3
    for kind in ('shifted', 'another'):
        assert reconstruct(faint.frame, config, Prior(predicted=given[kind])).outcome is Outcome.NO_DEVICE_A


def test_the_published_method_takes_only_the_order(scene, good):
    result = reconstruct(scene.frame, Config.from_values(method='paper'), Prior(predicted=good))
    assert result.outcome is Outcome.OK and result.prediction == 'agrees' and not result.warnings
    assert np.linalg.norm(result.shape.tip - scene.truth[-1]) < 1e-3
