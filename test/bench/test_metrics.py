"""Errors of curves whose distance is known by hand."""

import numpy as np
from numpy.testing import assert_allclose

from fluoro_shape_ros.metrics import compare, surprise

LINE = np.c_[np.linspace(0, 0.1, 11), np.zeros(11), np.zeros(11)]


def test_same_curve_has_no_error():
    e = compare(LINE, LINE)
    assert_allclose([e.mean, e.missed, e.worst, e.tip, e.length, e.matched], 0, atol=1e-9)


def test_shifted_aside():
    e = compare(LINE + [0, 0.001, 0], LINE)
    assert_allclose([e.mean, e.missed, e.worst, e.tip, e.matched], 0.001, rtol=1e-6)
    assert_allclose(e.length, 0, atol=1e-9)


def test_a_few_micrometres_aside_are_no_more():
    """Also where the samples of the curves stand side by side at half a step."""
    e = compare(LINE + [0.025e-3, 2e-6, 0], LINE)
    assert_allclose([e.mean, e.missed], 2e-6, rtol=1e-2)


def test_tip_cut_off():
    e = compare(LINE[:9], LINE)                     # 20 of 100 mm missing
    assert_allclose([e.tip, e.length, e.worst, e.matched], 0.02, rtol=1e-2)
    assert_allclose(e.mean, 0, atol=1e-6)
    assert_allclose(e.missed, 0.2 * 0.01, rtol=1e-2)    # a fifth of the truth lies 10 mm away on average


def test_base_cut_off_leaves_the_tip_alone():
    e = compare(LINE[2:], LINE)
    assert_allclose([e.tip, e.matched], 0, atol=1e-6)
    assert_allclose(e.length, 0.02, rtol=1e-6)


def test_length_is_that_of_the_curve_not_of_its_chords():
    turn = np.linspace(0, 2, 2001)
    arc = np.c_[0.05 * np.cos(turn), 0.05 * np.sin(turn), np.zeros(2001)]
    e = compare(arc[::40], arc)                         # chords of 2 mm are 0.017 mm shorter than the arc of 100 mm
    assert e.length < 1e-6
    assert_allclose([e.mean, e.tip], 0, atol=2e-6)
    # less than a step of comparison would show
    assert_allclose(compare(arc[:-7], arc).length, 0.05 * 2 * 7 / 2000, rtol=1e-3)


def test_surprise_counts_standard_deviations():
    covariance = np.diag([1.0, 4.0, 0.25])
    assert_allclose(surprise(np.array([1.0, 2.0, 0.5]), covariance), 3)
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert_allclose(surprise(turned @ [0, 4.0, 0], turned @ covariance @ turned.T), 4)


def test_surprise_where_nothing_or_too_much_is_claimed():
    error = np.array([1.0, 0, 0])
    assert np.isnan(surprise(error, np.full((3, 3), np.nan)))
    assert surprise(error, np.diag([0.0, 1, 1])) == np.inf
    assert surprise(error, np.diag([1.0, 0, 0])) == 1


def test_honest_reports_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    errors = rng.normal(size=(4000, 3)) @ root.T
    inside = np.mean([surprise(e, root @ root.T) <= 7.815 for e in errors])
    assert abs(inside - 0.95) < 0.015
