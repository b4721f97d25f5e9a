"""Every doubt by hand, and how honest what is left is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.method.fit.fit import Fit, contrast_ratio, shown
from fluoro_shape_ros.method.pipeline import CALIBRATION_PX, reconstruct
from fluoro_shape_ros.method.plausibility import (blunt, check_curvature, check_length, check_reprojection, check_tip, clear, curvature_limit, doubt,
                                           evidence)
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.geometry.spline import Spline3

ARC = 0.05 * np.c_[np.cos(np.linspace(0, 1, 9)), np.sin(np.linspace(0, 1, 9)), np.zeros(9)]     # 20 /m


def test_eq_3_limit_is_spacing_times_resolution_in_per_mm():
    # 10 px x 0.523 mm/px = 5.23, read as 5.23 /mm = 5230 /m
    assert_allclose(curvature_limit(Config.from_values(spacing_px=10.0), 0.523e-3), 5230)
    assert curvature_limit(Config.from_values(max_curvature=50.0), 0.523e-3) == 50


def test_curvature():
    assert check_curvature([ARC, ARC[:4]], 21) is None
    outcome, why = check_curvature([ARC[:0], ARC], 19)
    assert outcome is Outcome.CURVATURE and '20 /m exceeds 19 /m' in why


def test_length():
    config = Config.from_values(expected_length=[0.05, 0.1])
    assert check_length(0.07, config) is None and check_length(1.0, Config()) is None
    assert check_length(0.04, config)[0] is check_length(0.11, config)[0] is Outcome.LENGTH


def test_reprojection():
    config = Config.from_values(max_reprojection_px=1.0)
    assert check_reprojection(np.array([[0.5, 0.9], [0.5, 0.9], [9, 9]]), config) is None
    assert check_reprojection(np.array([[0.5, 1.1], [0.5, 1.1]]), config)[0] is Outcome.REPROJECTION


def test_tip_sigma_is_that_of_the_worst_direction():
    turned = Rotation.from_euler('xyz', [0.3, 1.0, -2.0]).as_matrix()
    covariance = turned @ np.diag([1e-8, 4e-8, 9e-8]) @ turned.T            # 0.1, 0.2, 0.3 mm
    assert check_tip(covariance, Config()) is None                          # no limit by default
    assert check_tip(covariance, Config.from_values(max_tip_sigma=0.31e-3)) is None
    outcome, why = check_tip(covariance, Config.from_values(max_tip_sigma=0.29e-3))
    assert outcome is Outcome.TIP_UNCERTAIN and '0.30 mm exceeds 0.29 mm' in why


@pytest.mark.parametrize('covariance', [np.diag([np.inf, 1e-8, 1e-8]), np.full((3, 3), np.inf), np.full((3, 3), np.nan)],
                         ids=['one way', 'all ways', 'NaN'])
def test_a_tip_nobody_knows_exceeds_every_limit(covariance):
    assert check_tip(covariance, Config.from_values(max_tip_sigma=1.0))[0] is Outcome.TIP_UNCERTAIN
    assert check_tip(covariance, Config()) is None


S = np.arange(-0.01, 0.07, 0.0003)      # m, a px each
MIN_LENGTH_PX = Config().detection.min_length_px


def device(**other):
    """A fit as a well seen device of 60 mm gives it, with some of it `other`."""
    present = np.repeat(((S > 0) & (S < 0.06)).astype(float)[:, None], 2, axis=1)
    straight = Spline3(-0.01, 0.07, np.c_[np.arange(10) * 0.01, np.zeros((10, 2))])
    clear = dict(spline=straight, start=0.0, stop=0.06, end_sigma=np.full(2, 2e-4), open_end=np.array([False, False]),
                 covariance=np.eye(30) * 1e-10, s=S, presence=present, offset_px=np.zeros((len(S), 2)),
                 contrast=np.array([0.25, 0.25]), across=np.array([0.25, 0.25]), width=0.9, odd_width=0.0,
                 likeness=np.array([0.99, 0.99]), weakest=np.array([0.95, 0.98]), beyond=np.zeros((2, 2)), aside=np.zeros((2, 2)),
                 fading=np.zeros(2), alone=np.full(2, -1), moved_px=0.0)
    return Fit(**clear | other)


def hidden(first, last, plane):
    """Presence of the device without what plane `plane` does not show between arc lengths first and last."""
    presence = device().presence.copy()
    presence[(S > first) & (S < last), plane] = 0.0
    return presence


def faded(to):
    """Presence of the device that is only so dark in both planes over its last 8 mm."""
    presence = device().presence.copy()
    presence[(S > 0.052) & (S < 0.06)] = to
    return presence


def test_a_clear_device_raises_no_doubt():
    assert doubt(device(presence=faded(0.75)), MIN_LENGTH_PX) is None
    assert doubt(device(), MIN_LENGTH_PX) is None
    enters = dict(open_end=np.array([True, False]), beyond=np.array([[1.0, 0.0], [0, 0]]))
    assert doubt(device(presence=hidden(0.03, 0.04, 1), **enters), MIN_LENGTH_PX) is None


@pytest.mark.parametrize('other, outcome, word', [
    (dict(stop=0.015), Outcome.NO_CORRESPONDENCE, '50 px'),
    (dict(contrast=np.array([0.25, 0.005]), across=np.array([0.25, 0.005])), Outcome.POORLY_EXPLAINED, 'round device'),
    (dict(likeness=np.array([0.5, 0.99])), Outcome.POORLY_EXPLAINED, '0.50'),
    (dict(aside=np.array([[0.5, 1.0], [0.0, 0.0]]), beyond=np.array([[0.1, -0.4], [0.0, 0.0]])), Outcome.POORLY_EXPLAINED, 'turns aside at its first end'),
    (dict(weakest=np.array([0.95, 0.7])), Outcome.POORLY_EXPLAINED, 'follows another line'),
    (dict(width=1.5, odd_width=0.31), Outcome.POORLY_EXPLAINED, '1.5 times'),
    (dict(width=0.5, odd_width=0.26), Outcome.POORLY_EXPLAINED, '0.5 times'),
    (dict(end_sigma=np.array([5e-5, 2e-3])), Outcome.DIRECTIONS_DISAGREE, 'last end'),
    (dict(contrast=np.array([0.1, 0.3]), across=np.array([0.1, 0.3])), Outcome.DIRECTIONS_DISAGREE, '3.0 times'),
    (dict(presence=hidden(0.01, 0.05, 1)), Outcome.POORLY_EXPLAINED, 'plane b'),
    (dict(presence=hidden(0.01, 0.05, 0)), Outcome.POORLY_EXPLAINED, 'plane a'),
    (dict(beyond=np.array([[0.9, 0.0], [0.0, 0.0]])), Outcome.DIRECTIONS_DISAGREE, 'first end'),
    (dict(beyond=np.array([[0.0, 0.0], [0.0, 0.9]])), Outcome.DIRECTIONS_DISAGREE, 'last end'),
    (dict(beyond=np.array([[0.0, 0.0], [-0.4, -0.3]])), Outcome.POORLY_EXPLAINED, 'last end'),
    (dict(aside=np.array([[0.0, 0.9], [0.9, 0.8]])), Outcome.POORLY_EXPLAINED, 'last end'),
    (dict(end_sigma=np.array([5e-5, 5e-4]), aside=np.array([[0.0, 0.0], [0.0, 0.9]])), Outcome.POORLY_EXPLAINED, 'last end is not clear'),
    (dict(presence=hidden(0.055, 0.07, 1)), Outcome.DIRECTIONS_DISAGREE, 'last end'),
    (dict(presence=faded(0.6)), Outcome.POORLY_EXPLAINED, 'fades towards its last end'),
    (dict(presence=faded(0.75), aside=np.array([[0.0, 0.0], [0.5, 0.45]])), Outcome.POORLY_EXPLAINED, 'fades towards its last end'),
    (dict(fading=np.array([-0.4, 0.0])), Outcome.POORLY_EXPLAINED, 'fades towards its first end'),
    (dict(presence=device().presence - 0.4 * (S > 0.052)[:, None] * [0, 1], aside=np.array([[0.0, 0.0], [0.0, 0.4]]), likeness=np.array([0.98, 0.98])),
     Outcome.POORLY_EXPLAINED, 'in one plane it fades'),
    (dict(open_end=np.array([True, True])), Outcome.DIRECTIONS_DISAGREE, 'no tip'),
])
def test_each_doubt_of_a_fit_has_its_name(other, outcome, word):
    found, why = doubt(device(**other), MIN_LENGTH_PX)
    assert found is outcome and word in why


@pytest.mark.parametrize('other', [
    dict(end_sigma=np.array([5e-5, 5e-4]), aside=np.array([[0.0, 0.9], [0.0, 0.0]])),      # the line is beside the other end
    dict(end_sigma=np.array([5e-5, 3e-4]), aside=np.array([[0.0, 0.0], [0.0, 0.9]])),      # the end is clear
    dict(end_sigma=np.array([5e-5, 5e-4]), aside=np.array([[0.0, 0.0], [0.0, 0.9]]), beyond=np.array([[0, 0], [0, 0.2]])),     # it crosses where the end points
], ids=['other end', 'clear end', 'straight on'])
def test_a_line_beside_a_clear_end_may_be_anything(other):
    assert doubt(device(**other), MIN_LENGTH_PX) is None


CLEAR = dict(end_sigma=np.full(2, 5e-5))
TURNED = dict(aside=np.array([[0.5, 1.0], [0.0, 0.0]]), beyond=np.array([[0.1, -0.4], [0.0, 0.0]]))


@pytest.mark.parametrize('other', [dict(likeness=np.array([0.94, 0.99])), dict(weakest=np.array([0.87, 0.98])), TURNED,
                                   dict(contrast=np.array([0.17, 0.25]), across=np.array([0.17, 0.25]), likeness=np.array([0.97, 0.97]))],
                         ids=['less like', 'less like in part', 'a line beside', 'less dark'])
def test_two_clear_ends_outweigh_what_alone_would_be_a_doubt(other):
    assert doubt(device(**other), MIN_LENGTH_PX) is not None
    assert doubt(device(**other, **CLEAR), MIN_LENGTH_PX) is None


@pytest.mark.parametrize('other', [dict(end_sigma=np.array([5e-5, 1.3e-4])), dict(open_end=np.array([True, False])),
                                   dict(beyond=np.array([[0.0, 0.0], [0.0, 0.45]]))], ids=['one is not', 'one leaves', 'one goes on'])
def test_ends_are_clear_only_together(other):
    assert clear(device(**CLEAR)) and not clear(device(**CLEAR | other))
    assert_allclose(evidence(device(**CLEAR)), 2 * evidence(device()))


ENTERS = dict(open_end=np.array([True, False]), end_sigma=np.array([0.0, 5e-5]), beyond=np.array([[1.0, 0.0], [0, 0]]))


def test_where_a_prediction_has_it_one_clear_end_is_enough():
    entering = device(**ENTERS, weakest=np.array([0.87, 0.98]))
    assert 'follows another line' in doubt(entering, MIN_LENGTH_PX)[1]
    assert doubt(entering, MIN_LENGTH_PX, expected=True) is None
    assert clear(entering, expected=True) and not clear(entering)
    assert not clear(device(**ENTERS | dict(end_sigma=np.array([0.0, 1.3e-4]))), expected=True)
    assert not clear(device(open_end=np.array([True, True])), expected=True)
    assert_allclose(evidence(entering, expected=True), 1.4 * np.sqrt(2) * evidence(entering))
    assert_allclose(evidence(device(**CLEAR), expected=True), 1.4 * evidence(device(**CLEAR)))
    assert not clear(device(**ENTERS, presence=faded(0.65)), expected=True)        # pale towards its end


def test_what_a_prediction_has_may_not_fade():
    assert 'fades' in doubt(device(**ENTERS, fading=np.array([0.0, -0.5])), MIN_LENGTH_PX, expected=True)[1]
    assert doubt(device(**CLEAR, fading=np.array([0.0, -0.5])), MIN_LENGTH_PX) is None      # but clear ends on both sides are no edge's


def test_with_an_end_that_a_line_hides_in_one_plane_the_rest_must_be_certain():
    alone = dict(aside=np.array([[0.0, 0.1], [0.9, 0.1]]), beyond=np.array([[0.0, 0.0], [0.3, -0.4]]), alone=np.array([-1, 1]))
    assert doubt(device(**alone), MIN_LENGTH_PX) is None
    assert 'a line hides' in doubt(device(**alone | dict(weakest=np.array([0.92, 0.98]))), MIN_LENGTH_PX)[1]
    assert 'a line hides' in doubt(device(**alone | dict(likeness=np.array([0.97, 0.97]))), MIN_LENGTH_PX)[1]
    assert 'fades' in doubt(device(**alone | dict(presence=faded(0.6))), MIN_LENGTH_PX)[1]


def test_an_end_that_leaves_the_field_is_not_blunt():
    assert blunt(device(end_sigma=np.array([5e-4, 5e-4]), open_end=np.array([True, False]))).tolist() == [False, True]
    assert not blunt(device()).any()


def test_how_a_foreshortened_device_may_differ_between_planes():
    # seen along itself a translucent device is darker: as if straight on both planes agree, and that is enough
    assert contrast_ratio(device(contrast=np.array([0.25, 0.6]))) == 1.0
    assert contrast_ratio(device(across=np.array([0.25, 0.1]))) == 1.0
    assert_allclose(contrast_ratio(device(contrast=np.array([0.2, 0.5]), across=np.array([0.2, 0.3]))), 1.5)


def test_shown_is_the_share_of_its_length_that_each_plane_shows():
    assert_allclose(shown(device(presence=hidden(0.03, 0.045, 1))), [1, 0.75], atol=0.01)
    outside = device().presence.copy()
    outside[(S > 0.03), 0] = np.nan
    assert_allclose(shown(device(presence=outside)), [0.5, 1], atol=0.01)


SCENES = dict(views=biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512)), lengths=(0.06, 0.07), anatomy=False)


@pytest.mark.parametrize('kind, seed', [('spline', 0), ('spline', 1), ('tangent', 0), ('tangent', 3)])
def test_half_a_pixel_of_calibration_error_is_borne_or_named(kind, seed):
    scene = xray_run(seed, kind=kind, **SCENES).scene()
    a, b = scene.frame.views
    across_lines = np.array([[1, 0, 0], [0, 1, 0.5], [0, 0, 1]])
    shifted = replace(scene.frame, views=(a, replace(b, P=across_lines @ b.P)))
    result = reconstruct(shifted, Config.from_values(base_position=scene.base_position.tolist()))
    if result.outcome is Outcome.OK:
        assert cKDTree(scene.truth).query(result.shape.points)[0].mean() < 0.33e-3       # 0.3 mm more than without
    else:
        assert result.outcome in (Outcome.REPROJECTION, Outcome.DIRECTIONS_DISAGREE, Outcome.POORLY_EXPLAINED)


def tip_surprise(scene, error_px=(0.0, 0.0)):
    """Squared distance of the tip found from the true one, by its covariance: chi square of 3 degrees of freedom where that is honest.

    error_px: (2, 2) u and v by which the calibration of each plane is off.
    """
    views = tuple(replace(v, P=v.P + np.outer([*e, 0.0], v.P[2])) for v, e in zip(scene.frame.views, np.broadcast_to(error_px, (2, 2))))
    shape = reconstruct(replace(scene.frame, views=views), Config.from_values(base_position=scene.base_position.tolist())).shape
    error = shape.tip - scene.truth[-1]
    return float(error @ np.linalg.solve(shape.covariance[-1], error))


def test_the_tip_is_as_certain_as_it_says():
    errors_px = np.random.default_rng(5).normal(0, CALIBRATION_PX, (14, 2, 2))      # as good as a calibration gets
    square = [tip_surprise(xray_run(seed, **SCENES).scene(), error) for seed, error in enumerate(errors_px)]
    assert np.mean(np.less(square, 7.81)) >= 0.85, square       # 95 % of chi square; 12 of 14 at least
    assert 0.5 < np.median(square) < 4                          # 2.4 is due


def test_a_tip_that_one_plane_sees_foreshortened_is_as_certain_as_it_says():
    run = xray_run(4, **SCENES)   # 23 degrees off plane B's ray: its end is a ramp there, 3 px long
    square = [tip_surprise(run.scene(index=k)) for k in range(9)]
    assert np.mean(square) < 6, square                          # 3 +- 0.8 is due
