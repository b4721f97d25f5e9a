"""Errors of curves whose distance is known by hand."""

import numpy as np
from numpy.testing import assert_allclose

from fluoro_shape_ros.metrics import compare

LINE = np.c_[np.linspace(0, 0.1, 11), np.zeros(11), np.zeros(11)]


def test_same_curve_has_no_error():
    e = compare(LINE, LINE)
    assert_allclose([e.mean, e.missed, e.worst, e.tip, e.length, e.matched], 0, atol=1e-9)


def test_shifted_aside():
    e = compare(LINE + [0, 0.001, 0], LINE)
    assert_allclose([e.mean, e.missed, e.worst, e.tip, e.matched], 0.001, rtol=1e-6)
    assert_allclose(e.length, 0, atol=1e-9)


def test_tip_cut_off():
    e = compare(LINE[:9], LINE)                     # 20 of 100 mm missing
    assert_allclose([e.tip, e.length, e.worst, e.matched], 0.02, rtol=1e-2)
    assert_allclose(e.mean, 0, atol=1e-6)
    assert_allclose(e.missed, 0.2 * 0.01, rtol=1e-2)    # a fifth of the truth lies 10 mm away on average


def test_base_cut_off_leaves_the_tip_alone():
    e = compare(LINE[2:], LINE)
    assert_allclose([e.tip, e.matched], 0, atol=1e-6)
    assert_allclose(e.length, 0.02, rtol=1e-6)
