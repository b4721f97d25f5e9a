"""Lines averaged along themselves: responses worked out by hand, and what must not show."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.imaging.oriented import DIRECTIONS, _spectra, along_lines

SIGMA, LENGTH = 1.2, 7.0    # px, of the filter across and along a line
LEVEL = 13.0
V, U = np.mgrid[0:181, 0:181] - 90.0


def across(angle_deg):
    """(H, W) px from the line through the middle at an angle to the columns' direction."""
    angle = np.deg2rad(angle_deg)
    return V * np.cos(angle) - U * np.sin(angle)


def line(angle_deg, s, depth=1.0):
    """A dark endless line of Gaussian profile, sigma `s` px."""
    return (LEVEL - depth * np.exp(-0.5 * (across(angle_deg) / s)**2)).astype(np.float32)


def textured(shape, seed=0):
    """(H, W) float32 noise about LEVEL."""
    return (LEVEL + np.random.default_rng(seed).normal(0, 1, shape)).astype(np.float32)


@pytest.mark.parametrize('s', [1.0, 1.5, 2.5])
@pytest.mark.parametrize('k', range(0, DIRECTIONS, 2))
def test_a_line_in_a_filters_direction_has_the_profile_of_the_second_derivative(k, s):
    """-sigma^2 d^2/dy^2 of exp(-y^2 / 2 s^2) blurred by sigma is sigma^2 s / S^3 (1 - y^2 / S^2) exp(-y^2 / 2 S^2),
    S^2 = s^2 + sigma^2; averaging along it is 1."""
    angle = 180 * k / DIRECTIONS
    found, y = along_lines(line(angle, s, 2.0), SIGMA, LENGTH)[80:101, 80:101], across(angle)[80:101, 80:101]
    S = np.hypot(s, SIGMA)
    expected = 2.0 * SIGMA**2 * s / S**3 * (1 - (y / S)**2) * np.exp(-0.5 * (y / S)**2)
    on = np.abs(y) < 0.7 * S        # farther off another direction answers more
    assert_allclose(found[on], expected[on], atol=1e-3)


@pytest.mark.parametrize('angle', [3.0, 7.5, 37.5, 52.0, 100.0, 171.0])
def test_between_directions_a_line_loses_what_its_turn_costs(angle):
    """Its spectrum lies along its normal, at d to the filter's: sigma^2 cos^2 d s / (s^2 + sigma^2 cos^2 d + length^2
    sin^2 d)^(3/2) in the middle."""
    s, turn = 1.5, np.deg2rad(angle) - np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    expected = SIGMA**2 * np.cos(turn)**2 * s / (s**2 + (SIGMA * np.cos(turn))**2 + (LENGTH * np.sin(turn))**2)**1.5
    assert_allclose(along_lines(line(angle, s), SIGMA, LENGTH)[90, 90], expected.max(), rtol=1e-3)


def test_a_bright_line_answers_less_than_a_dark_one():
    dark, bright = (along_lines(line(30, 1.5, depth), SIGMA, LENGTH)[90, 90] for depth in (1.0, -1.0))
    assert bright < 0.1 * dark


def test_a_dark_point_answers_alike_in_all_directions():
    """G_sigma(v) (1 - v^2 / sigma^2) G_length(u): 1 / (2 pi sigma length) at the point."""
    image = np.full(V.shape, LEVEL, np.float32)
    image[90, 90] -= 1
    found = along_lines(image, SIGMA, LENGTH)
    assert_allclose(found[90, 90], 1 / (2 * np.pi * SIGMA * LENGTH), rtol=0.02)
    assert found[90, 90] == found.max()


@pytest.mark.parametrize('shape', [(181, 181), (64, 75), (97, 64), (33, 41)])
def test_an_even_image_answers_nothing_nor_do_its_borders(shape):
    assert np.abs(along_lines(np.full(shape, LEVEL, np.float32), SIGMA, LENGTH)).max() < 1e-4 * LEVEL
    assert not along_lines(np.zeros(shape, np.float32), SIGMA, LENGTH).any()


def test_a_linear_ramp_answers_nothing_away_from_the_borders():
    ramp = along_lines((0.3 * U - 0.2 * V).astype(np.float32), SIGMA, LENGTH)
    inner = int(5 * LENGTH)
    assert np.abs(ramp[inner:-inner, inner:-inner]).max() < 1e-3


@pytest.mark.parametrize('sigma, length', [(1.2, 7.0), (1.2, 28.0), (2.0, 7.0)])
def test_noise_counts_by_the_norm_of_the_kernel_in_every_direction(sigma, length):
    """Parseval: its square is (2 pi)^-2 times the integral of sigma^4 w_v^4 exp(-sigma^2 w_v^2 - length^2 w_u^2), 3 /
    (16 pi sigma length)."""
    noise = np.fft.fft2(np.random.default_rng(0).normal(0, 1, (512, 512)))
    gain = np.sqrt(3 / (16 * np.pi * sigma * length))
    filters = [part for pair in _spectra(noise.shape, round(100 * sigma), round(100 * length))
               for part in (pair.real, pair.imag)]
    assert len(filters) == DIRECTIONS
    for spectrum in filters:
        assert_allclose(np.sqrt(np.mean(spectrum.astype(float)**2)), gain, rtol=0.01)
        assert_allclose(np.fft.ifft2(noise * spectrum).real.std(), gain, rtol=0.05)


def test_the_best_direction_of_noise_stays_below_a_line_too_faint_to_be_seen_in_a_pixel():
    noise = textured(V.shape) - LEVEL
    noisy = along_lines(line(45, 1.5) + noise, SIGMA, LENGTH)
    on = np.abs(across(45)) < 0.5
    assert np.median(noisy[on][20:-20]) > np.percentile(noisy[np.abs(across(45)) > 20], 97)
    assert np.median((line(45, 1.5) + noise)[on]) > np.percentile(noise + LEVEL, 10)       # that it needs averaging


def test_where_a_thing_lies_does_not_matter():
    image, (dv, du), far = textured((260, 250)), (13, 6), int(5 * LENGTH)
    one, other = (along_lines(image[v:v + 200, u:u + 200], SIGMA, LENGTH) for v, u in ((0, 0), (dv, du)))
    assert_allclose(one[far + dv:-far, far + du:-far], other[far:-far - dv, far:-far - du], atol=2e-4)


def test_a_turned_or_mirrored_image_has_the_turned_or_mirrored_answer():
    image = textured((120, 133))
    found, far = along_lines(image, SIGMA, LENGTH), int(6 * LENGTH)
    for change in (np.transpose, np.fliplr, np.flipud, lambda x: np.rot90(x, 2)):
        there = along_lines(np.ascontiguousarray(change(image)), SIGMA, LENGTH)
        # an even size has one frequency that is its own mirror
        assert_allclose(change(there)[far:-far, far:-far], found[far:-far, far:-far], atol=1e-3)


@pytest.mark.parametrize('shape', [(40, 40), (61, 74), (75, 91), (1, 30), (30, 1)])
def test_the_shape_stays_and_the_image_too(shape):
    image = textured(shape)
    before = image.copy()
    first, again = (along_lines(image, SIGMA, LENGTH) for _ in range(2))
    assert first.shape == shape and first.dtype == np.float32 and first.flags.c_contiguous and np.isfinite(first).all()
    assert np.array_equal(first, again) and np.array_equal(image, before)
