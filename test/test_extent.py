"""Where a device ends: stretches by hand, edges at known places, and errors as large as they are said to be."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr

from fluoro_shape_ros.method.fit.ends import bulge, locate, supported

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


@pytest.mark.parametrize('a, b, found', [
    ([(50, 149)], [(50, 149)], (50, 149)),
    ([(50, 149)], [(80, 189)], (80, 149)),                                              # what both show
    ([(50, 149), (170, 299)], [(50, 149), (170, 299)], (50, 299)),                      # 20 px of nothing: bridged
    ([(50, 149), (200, 299)], [(50, 149), (200, 299)], None),                           # 50 px of nothing: one of the two pieces
    ([(50, 299)], [(50, 149), (200, 299)], (50, 299)),                                  # 50 px hidden in one plane
    ([(50, 299)], [(50, 149), (240, 299)], (50, 149)),                                  # 90 px hidden: the longer piece
])
def test_the_stretch_that_both_planes_support(a, b, found):
    first, last = supported(presence(a, b))
    if found is None:
        assert (first, last) in ((50, 149), (200, 299))
    else:
        assert_allclose((first, last), found, atol=1)


def test_the_longer_of_two_pieces_counts():
    both = [(50, 129), (200, 299)]
    assert_allclose(supported(presence(both, both)), (200, 299), atol=1)


@pytest.mark.parametrize('a, b', [([], []), ([(50, 149)], [(200, 299)]), ([(50, 52)], [(50, 52)])])
def test_without_common_support_there_is_no_stretch(a, b):
    assert supported(presence(a, b)) is None


def test_outside_a_field_is_no_support():
    p = presence([(50, 299)], [(50, 299)])
    p[200:, 1] = np.nan
    assert_allclose(supported(p), (50, 199), atol=1)


def test_noise_moves_the_stretch_by_a_few_px_only():
    p = presence([(50, 299)], [(50, 299)]) + np.random.default_rng(0).normal(0, 0.25, (400, 2))
    assert_allclose(supported(p), (50, 299), atol=4)


def edge(end, outward=1, blur_px=1.1, noise=0.0, beyond=NONE, seed=0):
    """(N, 2) presence of a device that ends at `end` m in both planes, or at two ends, one a plane."""
    z = (outward * (np.broadcast_to(end, 2) - S[:, None]) + beyond) * SPEED
    return ndtr(z / blur_px) + np.random.default_rng(seed).normal(0, noise, z.shape)


def placed(s, presence, sigma, speed, guess, outward, beyond):
    """m: where the device ends, and its standard deviation."""
    end, = locate(s[None], presence.T[None], sigma[None], speed.T[None], np.array([guess]), np.array([outward]), beyond[None], np.zeros((1, 2)))
    return end.at, end.honest_sigma(SPEED.mean())


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
        at, sigma = placed(S, edge(end, noise=noise, seed=seed), np.full(2, noise), SPEED, end + (seed % 7 - 3) * PX, 1, NONE)
        z.append((at - end) / sigma)
    # chi square with 120 degrees of freedom over 120: 1 +- 0.13; the floor of the model makes it less
    assert 0.5 < np.mean(np.square(z)) < 1.4
    assert abs(np.mean(z)) < 0.35
    assert np.mean(np.abs(z) < 1.96) > 0.88


def test_where_the_planes_differ_the_less_foreshortened_one_counts_more():
    end = 100.4 * PX
    p = edge([end, end - 0.8 * PX])

    def at(ramp_px):
        found, = locate(S[None], p.T[None], np.full((1, 2), 0.02), SPEED.T[None], np.array([end]), np.array([1]), NONE[None], np.array([ramp_px]) * PX)
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


def test_bulge_by_hand():
    ones = np.ones(2)
    assert_allclose(bulge(0.001, ones, ones, np.array([0.9, 0.2])), 0, atol=1e-12)                      # seen square on: nothing
    slanted, opaque = np.full(2, np.sqrt(0.5)), np.array([0.9, 0.9])                                    # 45 degrees: cos / sin = 1
    reach = bulge(0.001, slanted, ones, opaque)
    assert (reach > 0.6e-3).all() and (reach < 0.25e-3 * np.pi).all()   # an ellipse reaches r at its middle, pi / 4 r on average
    assert_allclose(bulge(0.002, np.full(2, 0.6) * 3000, ones * 3000, opaque), reach * 2 * 0.8 / 0.6)
    half = np.log(1 - 0.5 * 0.3) / np.log(1 - 0.3)      # Beer-Lambert: the share of the path that takes half of 30 %
    assert_allclose(bulge(0.001, slanted, ones, np.array([0.3, 1e-4])), [0.5e-3 * (1 - 2 * half), 0], atol=3e-6)
