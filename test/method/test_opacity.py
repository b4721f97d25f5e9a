"""How opaque a device is, from how much darker it looks where it is seen at an angle; derived by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.geometry.cameras import slant
from fluoro_shape_ros.method.fit.opacity import RIM, USUAL, bulge, exponent, of_part, rim

SINE = np.stack([np.linspace(0.4, 1, 240), np.linspace(0.9, 0.5, 240)])
ALL = np.ones(SINE.shape, bool)


@pytest.mark.parametrize('power', [0.0, 0.5, 1.0])
@pytest.mark.parametrize('gain', [0.02, 30.0])
def test_the_power_that_darkness_grows_by_on_any_display(power, gain):
    dark = gain * np.array([[1.0], [7.0]]) * SINE**-power       # the planes' displays differ
    assert exponent(dark, SINE, ALL) == pytest.approx(power, abs=0.02)
    noisy = dark * (1 + np.random.default_rng(0).normal(0, 0.2, dark.shape))
    assert exponent(noisy, SINE, ALL) == pytest.approx(power, abs=0.12)


def test_rings_and_what_crosses_do_not_count():
    dark = SINE**-1.0
    dark[0, 60:90], dark[1, 100:112] = 9.0, 0.1
    assert exponent(dark, SINE, ALL) == pytest.approx(1.0, abs=0.05)
    assert exponent(np.where(ALL, dark, np.nan), SINE, ALL & (np.arange(240) < 60)) == pytest.approx(1.0, abs=0.05)


def test_what_tells_nothing_leaves_the_usual():
    square_on = np.ones((2, 240))
    assert exponent(2 * square_on, square_on, ALL) == pytest.approx(USUAL)
    assert exponent(SINE, SINE, ~ALL) == USUAL and exponent(-SINE, SINE, ALL) == USUAL


def test_a_curve_that_points_along_a_ray_somewhere_is_no_matter():
    steep, dark = SINE.copy(), SINE**-1.0
    steep[0, 100:112] = 0.0
    assert exponent(dark, steep, ALL) == pytest.approx(1.0, abs=0.1)     # the prior and the medians are moved a little
    assert np.isfinite(bulge(0.001, np.zeros(2), exponent(dark, 0 * SINE, ALL))).all()


def test_bulge_by_hand():
    slanted = np.array([np.sqrt(0.5), 0.6])     # cos / sin = 1 and 4 / 3
    assert_allclose(rim(0.001, slanted), [1e-3, 4e-3 / 3])
    assert_allclose([bulge(0.001, np.ones(2), k) for k in (0.0, 1.0)], 0, atol=1e-12)       # square on: nothing
    assert_allclose(bulge(0.001, slanted, 1.0), 0, atol=2e-6)                        # half as dark at the axis
    assert_allclose(bulge(0.002, slanted, 0.0), RIM * 2 * rim(0.001, slanted), rtol=0.05)   # all of the ellipse
    # Beer-Lambert with 70 % left after half the path and 49 % after all of it
    x = -np.log(0.49)
    half = -np.log(1 - 0.5 * (1 - np.exp(-x))) / x
    assert_allclose(bulge(0.001, slanted, x / np.expm1(x)), RIM * (1 - 2 * half) * rim(0.001, slanted),
                    rtol=1e-3)


def test_a_darker_part_is_more_opaque():
    """A shaft that takes 20 % of the beam, a part of it that takes 40 %, and an electrode that takes all."""

    def power(taken):
        return -np.log(1 - taken) * (1 - taken) / taken     # x / (exp(x) - 1)

    assert_allclose(of_part(power(0.2), np.array([1.0, 2.0, 5.0, 9.0])), [power(0.2), power(0.4), 0, 0], atol=2e-3)
    assert of_part(power(0.6), np.array(0.5)) == pytest.approx(power(0.3), abs=2e-3)
    assert of_part(1.0, np.array(1.0)) == pytest.approx(USUAL, abs=2e-3)      # there is no device that takes nothing


def test_the_angle_of_rays_by_hand():
    P = np.array([[1000.0, 0, 0, 0], [0, 1000, 0, 0], [0, 0, 1, 1]])     # source at (0, 0, -1)
    X = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    T = np.array([[2.0, 0, 0], [3, 0, 4], [1, 0, 1]])
    assert_allclose(slant(P, X, T), [1, 0.6, 0], atol=1e-12)
