"""Where a device ends: stretches by hand, edges at known places, and errors as large as they are said to be."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr

from fluoro_shape_ros.method.fit.ends import (
    ANOTHER,
    SMOOTH_PX,
    SURE,
    goes_on,
    level,
    locate,
    past_band,
    supported,
    windows,
)

PX = 1 / 3000.0                                             # m a pixel
S = np.arange(200) * PX
SPEED = np.full((200, 2), 3000.0) * [1.0, 0.8]              # plane B sees it foreshortened
NONE = np.zeros(2)


def presence(*planes, n=400):
    """(n, 2) ones in the stretches [first, last] of each plane."""
    out = np.zeros((n, 2))
    for v, stretches in enumerate(planes):
        for first, last in stretches:
            out[first:last + 1, v] = 1
    return out


def stretch(presence, clutter=0.1):
    """`supported` where places beside the device happen to look `clutter` dark."""
    return supported(presence, np.full((2, 1), clutter))


@pytest.mark.parametrize('a, b, found', [
    ([(50, 149)], [(50, 149)], (50, 149)),
    ([(50, 149)], [(80, 189)], (80, 149)),                                              # what both show
    ([(50, 149), (170, 299)], [(50, 149), (170, 299)], (50, 299)),                      # 20 px of nothing: bridged
    # 200 px of nothing: one of the two pieces
    ([(50, 149), (350, 399)], [(50, 149), (350, 399)], (50, 149)),
    ([(50, 299)], [(50, 149), (200, 299)], (50, 299)),                                  # 50 px hidden in one plane
    # a band 30 px past the end of what is seen
    ([(20, 119), (150, 157)], [(20, 119), (150, 157)], (20, 157)),
    ([(20, 119), (150, 157)], [(20, 119)], (20, 119)),                                  # which only one plane shows
    ([(20, 119), (250, 257)], [(20, 119), (250, 257)], (20, 119)),                      # or too far off
])
def test_the_stretch_that_both_planes_support(a, b, found):
    assert_allclose(stretch(presence(a, b)), found, atol=1)


def test_the_longer_of_two_pieces_counts():
    apart = [(20, 69), (290, 399)]
    assert_allclose(stretch(presence(apart, apart)), (290, 399), atol=1)


@pytest.mark.parametrize('step_px', [1, 3])
def test_a_stretch_is_never_a_strip_alone(step_px):
    """What one strip shows is noise; a curve of no length stopped the fit."""
    found = 0
    for seed in range(3000):
        rng = np.random.default_rng(seed)
        count, height = rng.integers(6, 60), rng.uniform(0, 1.5)
        seen = rng.normal(0, rng.uniform(0.1, 1.5), (count, 2))
        first, last = np.sort(rng.integers(0, count, 2))
        seen[first:last + 1] += height
        there = supported(seen, np.full((2, 1), rng.uniform(0.02, 0.5)), step_px)
        found += there is not None
        assert there is None or (there[1] - there[0]) * step_px >= 5
    assert found > 100


@pytest.mark.parametrize('a, b', [([], []), ([(50, 149)], [(200, 299)]), ([(50, 52)], [(50, 52)])])
def test_without_common_support_there_is_no_stretch(a, b):
    assert stretch(presence(a, b)) is None


def test_a_pale_part_counts_as_far_as_it_is_darker_than_places_beside_it():
    p = presence([(50, 199)], [(50, 199)])
    p[200:300] = 0.2
    assert_allclose(stretch(p, 0.05), (50, 299), atol=2)
    assert_allclose(stretch(p, 0.2), (50, 199), atol=1)


def test_outside_a_field_is_no_support():
    p = presence([(50, 299)], [(50, 299)])
    p[200:, 1] = np.nan
    assert_allclose(stretch(p), (50, 199), atol=1)


def test_noise_moves_the_stretch_by_a_few_px_only():
    p = presence([(50, 299)], [(50, 299)]) + np.random.default_rng(0).normal(0, 0.25, (400, 2))
    assert_allclose(stretch(p, 0.25 / 3), (50, 299), atol=4)


def test_the_fainter_a_device_the_longer_the_window_it_is_seen_over():
    """Of white noise, a window n times as long is worth sqrt(n) times the standard deviations."""
    assert_allclose(windows(np.array([20.0, 5.0])), SMOOTH_PX)
    assert_allclose(windows(np.array([2.5, 0.0])), [4 * SMOOTH_PX, 63])
    assert_allclose(windows(np.array([np.nan, np.inf])), [63, SMOOTH_PX])


def test_a_device_that_one_plane_hardly_shows_is_found_all_along():
    """1.5 standard deviations over 9 px in plane B: no single window shows it, 400 px do."""
    whole, short = 0, 0
    for seed in range(20):
        noise = np.array([0.4, 2.0])                        # of a strip, as a share of the device's darkness
        p = presence([(50, 449)], [(50, 449)], n=500) + np.random.default_rng(seed).normal(0, noise, (500, 2))
        over = noise / 3                                    # over 9 px
        first, last = supported(p, (over * 3 / np.sqrt(along := windows(1 / over)))[:, None], along_px=along)
        whole += abs(first - 50) < 20 and abs(last - 449) < 20
        there = supported(p, over[:, None])
        short += there is not None and abs(there[0] - 50) < 20 and abs(there[1] - 449) < 20
    assert whole >= 18 and short < 10


CLEAR, FAINT = 20.0, 2.5


def going_on(a, b, clear_a=CLEAR, clear_b=CLEAR, px=27, tried=1.0):
    """Nats of `goes_on` after `px`, where the planes show it by a and b standard deviations over SMOOTH_PX."""
    z = np.array([[a] * px, [b] * px], float)
    return goes_on(z, np.array([[clear_a], [clear_b]]), np.ones(z.shape), tried)[-1]


def test_what_both_planes_show_beyond_an_end_goes_on():
    three = 27 / SMOOTH_PX
    assert_allclose(going_on(CLEAR, CLEAR), three * SURE + ANOTHER)                     # by each for sure
    assert_allclose(going_on(CLEAR, CLEAR, tried=100.0), three * SURE + ANOTHER - np.log(10))
    # a faint device: z c - c^2 / 2 a window
    assert_allclose(going_on(CLEAR, FAINT, clear_b=FAINT), min(three * (SURE + FAINT**2 / 2),
                                                               three * FAINT**2 / 2 + ANOTHER))
    assert going_on(0, 0) < 0


@pytest.mark.parametrize('b, clear_b', [(0.0, CLEAR), (-1.0, CLEAR), (0.0, FAINT)])
def test_what_one_plane_shows_beyond_an_end_may_be_another_line(b, clear_b):
    assert going_on(CLEAR, b, clear_b=clear_b) < ANOTHER
    assert going_on(CLEAR, b, clear_b=clear_b, px=60) < 0


def test_a_faint_plane_does_not_tell_against_what_the_other_shows():
    """Where a device cannot be seen, that it is not seen tells nothing."""
    assert going_on(CLEAR, 0.0, clear_b=0.1) > 0.9 * ANOTHER


def test_noise_makes_no_band_of_a_plain_end():
    inward = np.arange(-12, 200) * PX
    bands = 0
    for seed in range(100):
        p = np.where(inward < 0, 0.0, 1.0) + np.random.default_rng(seed).normal(0, 0.9, (2, len(inward)))
        seen, inner = level(p, inward, PX, np.full(2, 0.9))
        bands += inner < np.inf
        assert_allclose(seen, 1, atol=0.6)
    assert bands < 20


@pytest.mark.parametrize('height, length_px, inner_px', [(1.0, 60, np.inf), (3.0, 8, 8), (0.3, 14, 14)])
def test_how_dark_a_device_is_at_its_end_and_how_far_that_goes(height, length_px, inner_px):
    """A plain end, one with a band, and a pale tip."""
    inward = np.arange(-12, 60) * PX
    p = np.where(inward < 0, 0.0, np.where(inward < length_px * PX, height, 1.0))
    seen, inner = level(np.stack([p, p]), inward, PX)
    assert_allclose(seen, height, rtol=0.15)
    if np.isinf(inner_px):
        assert inner == np.inf
    else:
        assert abs(inner / PX - inner_px) < 3


@pytest.mark.parametrize('height', [0.7, 4.0])
@pytest.mark.parametrize('plane', [0, 1])
def test_a_part_at_an_end_that_one_plane_alone_shows(height, plane):
    """As an electrode is no darker than the shaft on a display that is black there already."""
    inward = np.arange(-16, 16.5, 0.5) * PX
    p = np.where(inward < 0, 0.0, np.ones((2, 1))) + np.random.default_rng(3).normal(0, 0.05, (2, len(inward)))
    p[plane, (inward >= 0) & (inward < 9 * PX)] *= height
    seen, inner = level(p, inward, PX, np.full(2, 0.05))
    assert_allclose(seen, np.where(np.arange(2) == plane, height, 1), rtol=0.1)
    assert abs(inner / PX - 9) < 1


def test_the_fading_of_a_slanted_end_is_no_part_of_its_own():
    inward = np.arange(-16, 16.5, 0.5) * PX
    fading = np.clip(0.5 + inward / (12 * PX), 0, 1)       # 6 px to either side
    seen, inner = level(np.stack([fading, fading]), inward, PX, fade=np.full(2, 6 * PX))
    assert_allclose(seen, 1, atol=0.02)
    assert inner == np.inf and level(np.stack([fading, fading]), inward, PX)[1] < np.inf


@pytest.mark.parametrize('tip_px, clutter, expected_px, unsure_px', [(3, 0.03, 3, 0.6), (0, 0.03, 0, 0.6)])
def test_a_pale_tip_past_a_band_is_measured_where_it_is_seen(tip_px, clutter, expected_px, unsure_px):
    inward = np.arange(-16, 16.5, 0.5) * PX
    p = np.select([inward < -tip_px * PX, inward < 0, inward < 6 * PX], [0.0, 0.4, 3.0], 0.4)
    past, sigma = past_band(np.stack([p, p]), inward, 6 * PX, np.full(2, clutter), NONE, PX)
    assert abs(past / PX - expected_px) < 0.5 and sigma / PX < unsure_px


def test_a_pale_tip_that_cannot_be_seen_makes_the_end_uncertain():
    inward = np.arange(-16, 16.5, 0.5) * PX
    p = np.select([inward < 0, inward < 6 * PX], [0.0, 3.0], 0.2)
    past, sigma = past_band(np.stack([p, p]), inward, 6 * PX, np.full(2, 2.0), NONE, PX)
    assert 0.3e-3 < past < 0.7e-3 and 0.4e-3 < sigma < 0.8e-3          # half on none, half anywhere up to 2 mm
    assert past_band(np.ones((2, len(inward))), inward, np.inf, np.full(2, 2.0), NONE, PX) == (0, 0)      # no band
    assert past_band(np.stack([p, p]), inward, -PX, np.full(2, 2.0), NONE, PX) == (0, 0)                  # nor here


def test_what_a_bands_own_end_may_darken_is_no_pale_tip():
    inward = np.arange(-16, 16.5, 0.5) * PX
    p = np.select([inward < 0, inward < 6 * PX], [0.0, 3.0], 0.4) + np.zeros((2, 1))
    p[0, (inward < 0) & (inward > -5 * PX)] = 0.6                # plane A sees the band's rim at an angle
    seen = [past_band(p, inward, 6 * PX, np.full(2, 0.03), np.array([rim * PX, 0]), PX)[0] / PX for rim in (0, 5)]
    assert seen[0] > 1.5 and seen[1] < 0.5


def edge(end, outward=1, blur_px=1.1, noise=0.0, beyond=NONE, seed=0):
    """(N, 2) presence of a device that ends at `end` m in both planes, or at two ends, one a plane."""
    z = (outward * (np.broadcast_to(end, 2) - S[:, None]) + beyond) * SPEED
    return ndtr(z / blur_px) + np.random.default_rng(seed).normal(0, noise, z.shape)


def placed(s, presence, sigma, speed, guess, outward, beyond):
    """m: where the device ends, and its standard deviation."""
    end, = locate(s[None], presence.T[None], sigma[None], speed.T[None], np.array([guess]), np.array([outward]),
                  beyond[None], np.zeros((1, 2)))
    return end.at, end.honest_sigma


@pytest.mark.parametrize('outward', [1, -1])
@pytest.mark.parametrize('blur_px', [0.8, 1.3, 2.0])
@pytest.mark.parametrize('guess_px', [-8, 0.4, 8])
def test_a_blurred_edge_is_found(outward, blur_px, guess_px):
    end = 100.37 * PX
    at, sigma = placed(S, edge(end, outward, blur_px), np.full(2, 0.05), SPEED, end + guess_px * PX, outward, NONE)
    assert abs(at - end) < 0.1 * PX
    assert 0.05 * PX < sigma < 0.5 * PX


def test_the_bulge_is_taken_off():
    beyond = np.array([2.0, 3.0]) * PX
    end = 100 * PX
    at, sigma = placed(S, edge(end, beyond=beyond), np.full(2, 0.05), SPEED, end, 1, beyond)
    assert abs(at - end) < 0.1 * PX
    assert sigma > placed(S, edge(end), np.full(2, 0.05), SPEED, end, 1, NONE)[1]       # and trusted less


@pytest.mark.parametrize('noise', [0.2, 0.3])
def test_sigma_is_the_scatter_over_noise(noise):
    z, n = [], 120
    for seed in range(n):
        end = (90 + 0.173 * seed) * PX
        at, sigma = placed(S, edge(end, noise=noise, seed=seed), np.full(2, noise), SPEED,
                           end + (seed % 7 - 3) * PX, 1, NONE)
        z.append((at - end) / sigma)
    # chi square with 120 degrees of freedom over 120: 1 +- 0.13; the floor of the model makes it less
    assert 0.5 < np.mean(np.square(z)) < 1.4
    assert abs(np.mean(z)) < 0.35
    assert np.mean(np.abs(z) < 1.96) > 0.88


def test_what_a_faint_plane_says_of_an_end_is_worth_little():
    """Its edge may be any of several."""
    z, disagreed = [], 0
    for seed in range(100):
        end = (90 + 0.173 * seed) * PX
        p = edge(end) + np.random.default_rng(seed).normal(0, [0.2, 1.5], (200, 2))
        found, = locate(S[None], p.T[None], np.array([[0.2, 1.5]]), SPEED.T[None], np.array([end]), np.array([1]),
                        NONE[None], np.zeros((1, 2)))
        disagreed += found.disagreed
        z.append((found.seen_at[1] - end) / found.seen_sigma[1])
    assert disagreed < 3 and 0.3 < np.sqrt(np.mean(np.square(z))) < 1.5 and np.mean(np.abs(z) < 2) > 0.9


def test_where_the_planes_differ_the_less_foreshortened_one_counts_more():
    end = 100.4 * PX
    p = edge([end, end - 0.8 * PX])

    def at(ramp_px):
        found, = locate(S[None], p.T[None], np.full((1, 2), 0.02), SPEED.T[None], np.array([end]), np.array([1]),
                        NONE[None], np.array([ramp_px]) * PX)
        return found.at

    assert abs(at([0.0, 5.0]) - end) < 0.15 * PX                # the model of plane B's end is worth half a px
    assert abs(at([5.0, 0.0]) - end + 0.8 * PX) < 0.15 * PX
    assert abs(at([0.0, 0.0]) - end + 0.4 * PX) < 0.15 * PX


def test_one_plane_will_do_and_knows_less():
    end = 100.4 * PX
    both = edge(end)
    one = both.copy()
    one[:, 1] = np.nan
    at, sigma = placed(S, one, np.full(2, 0.2), SPEED, end + PX, 1, NONE)
    assert abs(at - end) < 0.1 * PX
    assert sigma > placed(S, both, np.full(2, 0.2), SPEED, end + PX, 1, NONE)[1]


def test_no_plane_leaves_the_guess_and_knows_nothing():
    at, sigma = placed(S, np.full((200, 2), np.nan), np.full(2, 0.1), SPEED, 0.03, 1, NONE)
    assert at == 0.03 and sigma == np.inf


@pytest.mark.parametrize('apart_px', [3, 6, 9])
def test_planes_that_disagree_widen_sigma_by_half_their_difference(apart_px):
    ends = np.array([100, 100 + apart_px]) * PX
    at, sigma = placed(S, edge(ends), np.full(2, 0.1), SPEED, ends.mean(), 1, NONE)
    assert ends[0] - PX < at < ends[1] + PX
    assert sigma > 0.4 * apart_px * PX
