"""Ridges and chains of drawings: lines of known place, a T, a crossing, gaps, and nothing at all."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.imaging.lines import find_candidates
from fluoro_shape_ros.imaging.ridges import find_ridges, ridge_scale

V, U = np.mgrid[0:200, 0:240].astype(float)
FIELD = np.full(U.shape, 255, np.uint8)
SIGMA = 1.5
LINES = [((30, 60.3), (210, 60.3)), ((40.4, 20), (40.4, 180)), ((30, 30.2), (200, 170)), ((30, 100.5), (200, 120))]


def segment(p, q):
    """(H, W) distance of every pixel from the segment from p to q."""
    p, d = np.array(p, float), np.subtract(q, p, dtype=float)
    t = np.clip(((U - p[0]) * d[0] + (V - p[1]) * d[1]) / (d @ d), 0, 1)
    return np.hypot(U - p[0] - t * d[0], V - p[1] - t * d[1])


def draw(*distances, noise=0.2, seed=0):
    """Dark lines of Gaussian profile (sigma 1.5 px, 20 deep) where a distance is 0, on a level of 100."""
    d = np.min(distances, axis=0)
    return (100 - 20 * np.exp(-0.5 * (d / SIGMA) ** 2)
            + np.random.default_rng(seed).normal(0, noise, d.shape)).astype(np.float32)


def chains(image, min_length_px=50.0, field=FIELD):
    return find_candidates(find_ridges(image, field, SIGMA), min_length_px)


def joins(candidate, p, q, within=5.0):
    """Whether a candidate's ends are p and q, in either order; a ridge overshoots a line's end by about its width."""
    ends = candidate.points_px[[0, -1]]
    return min(np.abs(ends - [p, q]).max(), np.abs(ends - [q, p]).max()) < within


@pytest.mark.parametrize('p, q', LINES)
def test_ridge_points_of_a_line_lie_on_it_and_in_its_order(p, q):
    best, *others = chains(draw(segment(p, q)))
    assert not others and joins(best, p, q)
    length = np.linalg.norm(np.subtract(q, p))
    t = np.subtract(q, p) / length
    along, across = (best.points_px - p) @ t, (best.points_px - p) @ [-t[1], t[0]]
    inner = (along > 5) & (along < length - 5)
    assert np.abs(across[inner]).max() < 0.1
    steps = np.diff(along if along[-1] > along[0] else along[::-1])
    assert -0.5 < steps.min() and steps.max() < 2       # sub-pixel points of neighbouring pixels may swap by a fraction
    assert np.abs(across[inner].mean()) < 0.02


def test_ridge_points_of_a_circle_lie_on_it():
    ridges = find_ridges(draw(np.abs(np.hypot(U - 120, V - 100) - 60)), FIELD, SIGMA)
    strong = ridges.z > 8       # single points of the noise reach 3.5 standard deviations, as they must
    assert strong.sum() > 300
    assert np.abs(np.hypot(*(ridges.points_px[strong] - [120, 100]).T) - 60).max() < 0.1


def test_a_ring_is_one_chain_that_goes_round_once():
    ring, = chains(draw(np.abs(np.hypot(U - 120, V - 100) - 60)))
    turned = np.unwrap(np.arctan2(*(ring.points_px - [120, 100]).T[::-1]))
    assert_allclose(abs(turned[-1] - turned[0]), 2 * np.pi, atol=0.1)


def test_a_t_is_a_line_and_a_stem():
    through, stem = chains(draw(segment((20, 100), (220, 100)), segment((120, 100), (120, 180))))
    assert joins(through, (20, 100), (220, 100)) and np.abs(through.points_px[:, 1] - 100).max() < 3
    assert joins(stem, (120, 100), (120, 180))


def test_two_lines_that_cross_are_each_followed_straight_on():
    p, q, r, s = (30, 60), (210, 140), (30, 140), (210, 60)
    found = chains(draw(segment(p, q), segment(r, s)))
    assert len(found) == 2
    assert any(joins(c, p, q) for c in found) and any(joins(c, r, s) for c in found)


def test_a_band_of_metal_does_not_hide_a_pale_line():
    p, q = (30, 60.3), (210, 60.3)
    band = 100 * np.exp(-0.5 * (segment((120, 140), (126, 140)) / SIGMA) ** 2)
    pale = 100 + (draw(segment(p, q), noise=0.4) - 100) * 0.025       # half a grey level deep
    assert joins(chains(pale)[0], p, q) and joins(chains((pale - band).astype(np.float32))[0], p, q)


def test_a_gap_is_bridged_and_marked():
    line, = chains(draw(segment((20, 100), (100, 100)), segment((120, 100), (220, 100))))
    assert joins(line, (20, 100), (220, 100))
    hidden = line.points_px[line.z == 0]
    assert len(hidden) > 10 and hidden[:, 0].min() > 100 and hidden[:, 0].max() < 120
    assert np.linalg.norm(np.diff(line.points_px, axis=0), axis=1).max() < 2.1      # filled


@pytest.mark.parametrize('second', [((160, 100), (225, 100)), ((130, 112), (130, 180)), ((120, 130), (220, 130))],
                         ids=['too far', 'round a corner', 'beside'])
def test_what_does_not_continue_a_line_stays_another(second):
    first = (20, 100), (100, 100)
    found = chains(draw(segment(*first), segment(*second)))
    assert len(found) == 2
    assert any(joins(c, *first) for c in found) and any(joins(c, *second) for c in found)


def test_candidates_are_the_longest_and_strongest_first_and_long_enough():
    image = draw(segment((20, 41), (180, 41)), segment((20, 101), (120, 101)), segment((20, 157), (50, 157)))
    long, short = chains(image, 60.0)
    assert joins(long, (20, 41), (180, 41)) and joins(short, (20, 101), (120, 101)) and long.score > short.score > 0
    assert len(find_candidates(find_ridges(image, FIELD, SIGMA), 60.0, count=1)) == 1


@pytest.mark.parametrize('seed', range(4))
def test_noise_holds_no_candidate(seed):
    image = np.random.default_rng(seed).normal(100, 5, (300, 300)).astype(np.float32)
    assert not chains(image, 10.0, np.full(image.shape, 255, np.uint8))


@pytest.mark.parametrize('v', [96, 98, 101, 104])
def test_a_line_is_found_on_whatever_row_it_lies(v):
    line, = chains(draw(segment((20, v), (220, v))))
    assert joins(line, (20, v), (220, v))


@pytest.mark.parametrize('level', [0, 3 ** 0.5, 10, 100, 60000])
def test_an_even_image_has_no_ridges(level):
    image = np.full((300, 300), level, np.float32)
    assert len(find_ridges(image, np.full(image.shape, 255, np.uint8), SIGMA).z) == 0


def test_bright_lines_and_steps_are_no_ridges():
    assert not chains(200 - draw(segment(*LINES[0])))
    assert not chains(np.where(U + 0.3 * V < 130, 100, 60).astype(np.float32), 30.0)


def test_only_the_field_counts():
    field = FIELD.copy()
    field[:, 130:] = 0
    line, = chains(draw(segment((20, 100), (220, 100))), field=field)
    assert 120 < line.points_px[:, 0].max() <= 130 and line.points_px[:, 0].min() < 25
    assert not chains(draw(segment((20, 100), (220, 100))), field=np.zeros_like(FIELD))


def test_the_scale_grows_with_the_device_and_never_vanishes():
    assert ridge_scale(0.0) == 1.2 and ridge_scale(2.0) < ridge_scale(4.0)
    assert_allclose(ridge_scale(2.0), 1.2 * np.hypot(1.0, 0.8))
