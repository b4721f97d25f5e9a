"""The B-spline against what splines are known for: straight lines, parabolas, arcs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.geometry.spline import Spline3, bending, prolong, through

END = np.array([0.06, 0.03, 0.02])
LENGTH = float(np.linalg.norm(END))                 # 0.07 m
ARC_RADIUS = 0.05


def straight(n=30):
    return np.linspace([0, 0, 0], END, n)


def arc(s):
    """(N, 3) points of a circle in the plane z = 0 that starts along +x."""
    return ARC_RADIUS * np.c_[np.sin(s / ARC_RADIUS), 1 - np.cos(s / ARC_RADIUS), 0 * s]


def wavy(n=12):
    return Spline3(-0.01, 0.08, np.random.default_rng(0).normal(size=(n, 3)))


def test_the_basis_sums_to_one_and_is_the_curve():
    spline, s = wavy(), np.linspace(-0.01, 0.08, 77)
    assert_allclose(spline.bases(s, 0)[0].sum(axis=1), 1, atol=1e-12)
    assert (spline.bases(s, 0)[0] >= -1e-12).all()
    assert_allclose(spline.bases(s, 0)[0] @ spline.control, spline(s), atol=1e-12)


@pytest.mark.parametrize('order', [1, 2])
def test_derivatives_are_those_of_the_curve(order):
    spline, s, h = wavy(), np.linspace(0.0, 0.07, 50), 1e-6
    numeric = (spline(s + h, order - 1) - spline(s - h, order - 1)) / (2 * h)
    assert_allclose(spline(s, order), numeric, rtol=1e-3, atol=1e-3 * np.abs(numeric).max())


def test_a_parabola_by_hand_and_without_bending_energy():
    # at a knot the weights are 1/6, 4/6, 1/6: of j^2 about j = 1 that makes 1 + 1/3
    j = np.arange(9.0)
    spline = Spline3(0.0, 6.0, np.c_[j, j**2, 0 * j])
    x = np.linspace(0, 6, 61)
    assert_allclose(spline(x), np.c_[x + 1, (x + 1) ** 2 + 1 / 3, 0 * x], atol=1e-12)
    assert_allclose(bending(9) @ spline.control, 0, atol=1e-12)
    assert_allclose(bending(9) @ j**3, 6, atol=1e-12)       # third differences of a cubic: 3!
    assert bending(9).shape == (6, 9)


def test_through_a_straight_line_it_is_that_line_also_where_it_goes_on():
    spline = through(straight(), 0.01)
    assert_allclose([spline.start, spline.stop], [-0.01, LENGTH + 0.01])
    s = np.linspace(spline.start, spline.stop, 50)
    assert_allclose(spline(s), s[:, None] * END / LENGTH, atol=1e-12)
    assert_allclose(np.linalg.norm(spline(s, 1), axis=1), 1, atol=1e-9)


def test_through_an_arc_it_stays_on_it():
    s = np.linspace(0, 0.08, 2000)
    spline = through(arc(s), 0.005)
    assert_allclose(spline(s), arc(s), atol=1e-5)           # also that s counts from the first point
    assert_allclose(np.linalg.norm(spline(s, 1), axis=1), 1, atol=5e-3)


def test_it_smooths_jitter():
    rng = np.random.default_rng(1)
    noisy = straight(141) + rng.normal(0, 5e-5, (141, 3))
    off = np.linalg.norm(np.cross(through(noisy, 0.0)(np.linspace(0.002, 0.06, 200)), END / LENGTH), axis=1)
    assert off.mean() < 0.6 * np.linalg.norm(np.cross(noisy, END / LENGTH), axis=1).mean()


@pytest.mark.parametrize('ends, shift', [((True, False), 0.03), ((False, True), 0.01), ((True, True), 0.03),
                                         ((False, False), 0.01)])
def test_prolonged_it_goes_on_straight_and_keeps_its_place(ends, shift):
    spline = through(straight(), 0.01)
    longer, added = prolong(spline, ends, 0.02)
    assert_allclose(added, shift, atol=1e-9)                # old arc lengths began at -0.01
    assert_allclose(longer.stop - longer.start, LENGTH + 0.02 + 0.02 * sum(ends), atol=1e-9)
    s = np.linspace(longer.start, longer.stop, 60)
    assert_allclose(longer(s), (s - added)[:, None] * END / LENGTH, atol=1e-9)


def test_prolonged_an_arc_goes_on_along_its_last_tangent():
    spline = through(arc(np.linspace(0, 0.08, 1000)), 0.0)
    longer, added = prolong(spline, (False, True), 0.02)
    end, tangent = arc(np.array([0.08]))[0], np.array([np.cos(1.6), np.sin(1.6), 0.0])
    assert_allclose(longer(np.array([longer.stop]))[0], end + 0.02 * tangent, atol=3e-4)        # a pixel
    assert_allclose(longer(np.linspace(0.0, 0.06, 20) + added), arc(np.linspace(0.0, 0.06, 20)), atol=1e-4)
