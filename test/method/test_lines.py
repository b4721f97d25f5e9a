"""What one image shows as a line of the device's width, and which line of plane A may be which of plane B."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial import cKDTree

from fluoro_shape_ros.bench.families import families
from fluoro_shape_ros.geometry.cameras import project, undistort
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.lines import Candidate
from fluoro_shape_ros.imaging.prepare import sheet_of
from fluoro_shape_ros.imaging.profiles import shadow
from fluoro_shape_ros.imaging.strips import Sheet
from fluoro_shape_ros.method.propose.lines import CANDIDATES, by_lines, candidates
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

SIZE = 400
VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=SIZE, height=SIZE))
WIDE = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
RADIUS, HALF_WIDTH = 0.0006, 2.0        # m, and px of it
MIN_LENGTH = 60.0
V, U = np.mgrid[0:SIZE, 0:SIZE] - (SIZE - 1) / 2
LEVEL, NOISE = 13.0, 0.2                # of square roots of counts
LENGTH = 240.0                          # px


def across(angle_deg, bend):
    """(H, W) px along a line through the middle, or a parabola about it that bends by so many 1/px, and beside it."""
    angle = np.deg2rad(angle_deg)
    x = U * np.cos(angle) + V * np.sin(angle)
    return x, V * np.cos(angle) - U * np.sin(angle) - 0.5 * bend * x**2


def drawn(angle_deg, bend, snr, seed, half_width=HALF_WIDTH):
    """(H, W) float32: the shadow of a cylinder, `snr` times as dark in its middle as the noise of a pixel."""
    x, y = across(angle_deg, bend)
    dark = shadow(half_width, y.ravel()).reshape(y.shape) * (np.abs(x) < LENGTH / 2)
    return (LEVEL - snr * NOISE * dark + np.random.default_rng(seed).normal(0, NOISE, y.shape)).astype(np.float32)


def sheet(*images, views=VIEWS):
    return Sheet.of(images, [np.full(i.shape, 255, np.uint8) for i in images], views)


def off(line, angle_deg, bend):
    """(N,) px by which a candidate lies beside the drawn line, roughly."""
    u, v = np.rint(line.points_px).astype(int).T
    return np.abs(across(angle_deg, bend)[1][v, u])


LINES = (37.0, 0.0), (100.0, 2e-3)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('snr', [1.25, 1.5])
def test_what_no_pixel_shows_is_found_along_itself(snr, seed):
    pair = sheet(*(drawn(*line, snr, 10 * seed + k) for k, line in enumerate(LINES)))
    assert candidates(pair, RADIUS, MIN_LENGTH, faint=False) == ([], [])
    for (best, *_), line in zip(candidates(pair, RADIUS, MIN_LENGTH, faint=True), LINES):
        inside = np.abs(across(*line)[0][tuple(np.rint(best.points_px).astype(int).T[::-1])]) < LENGTH / 2 - 10
        assert np.median(off(best, *line)[inside]) < 1 and inside.sum() > 0.8 * LENGTH


@pytest.mark.parametrize('faint', [False, True])
def test_a_plain_line_is_found_either_way(faint):
    found = candidates(sheet(*(drawn(*line, 6.0, k) for k, line in enumerate(LINES))), RADIUS, MIN_LENGTH, faint)
    for (best, *_), line in zip(found, LINES):
        assert np.percentile(off(best, *line), 80) < 1 and len(best.points_px) > 0.9 * LENGTH


@pytest.mark.parametrize('faint', [False, True])
@pytest.mark.parametrize('seed', range(4))
def test_noise_holds_no_candidate(faint, seed):
    rng = np.random.default_rng(seed)
    noise = sheet(*(rng.normal(LEVEL, NOISE, (SIZE, SIZE)).astype(np.float32) for _ in VIEWS))
    assert candidates(noise, RADIUS, MIN_LENGTH, faint) == ([], [])


@pytest.mark.parametrize('faint', [False, True])
@pytest.mark.parametrize('size', [400, 512])
@pytest.mark.parametrize('level', [0.0, 1.0, 3**0.5, 240**0.5])
def test_an_even_pair_holds_no_candidate(faint, level, size):
    even = np.full((size, size), level, np.float32)
    assert candidates(sheet(even, even), RADIUS, MIN_LENGTH, faint) == ([], [])


@pytest.mark.parametrize('faint', [False, True])
def test_only_the_field_counts(faint):
    images, field = [drawn(*line, 6.0, k) for k, line in enumerate(LINES)], np.full((SIZE, SIZE), 255, np.uint8)
    half = field.copy()
    half[:, SIZE // 2:] = 0
    for found, dark in zip(candidates(Sheet.of(images, [half, 0 * field], VIEWS), RADIUS, MIN_LENGTH, faint),
                           (False, True)):
        assert bool(found) != dark and all(c.points_px[:, 0].max() < SIZE // 2 + 1 for c in found)


def test_a_line_of_the_devices_width_is_liked_better_than_a_wider_one():
    image = (100 - 20 * np.sqrt(np.maximum(1 - ((V + 60) / 2) ** 2, 0))
             - 30 * np.sqrt(np.maximum(1 - ((V - 50) / 7) ** 2, 0)))
    noisy = (image + np.random.default_rng(0).normal(0, 0.5, V.shape)).astype(np.float32)
    for found in candidates(sheet(noisy, noisy), RADIUS, MIN_LENGTH, faint=False):
        assert abs(np.median(found[0].points_px[:, 1]) - (SIZE - 1) / 2 + 60) < 1
        assert all(c.score < 0.5 * found[0].score for c in found[1:])


@pytest.mark.parametrize('seed', [0, 1, 2])
# an average along a line goes on past its end, and smooths bends
@pytest.mark.parametrize('faint, share', [(False, 0.7), (True, 0.5)])
def test_the_device_is_among_the_best_candidates_of_either_image(seed, faint, share):
    scene = xray_run(seed, views=WIDE, lengths=(0.06, 0.08)).scene()
    images = scene.frame.images
    for view, found in zip(WIDE, candidates(sheet_of(images, [field_of_view(i) for i in images], WIDE, 'dark'), RADIUS,
                                            MIN_LENGTH, faint)):
        assert 0 < len(found) <= CANDIDATES and all(0 < c.score <= 1 for c in found)
        true = cKDTree(project(view.P, scene.truth))
        assert max(np.mean(true.query(c.points_px)[0] < 2) for c in found) > share


# ---- lines of both planes


def seen(points, view, score=0.9):
    """The candidate that a curve (N, 3) is in a view."""
    line = project(view.P, points)
    line = at_arc_length(line, np.arange(0, arc_length(line)[-1]))
    return Candidate(line, np.ones(len(line)), score)


def device(**shift):
    s = np.linspace(0, 1, 400)
    return np.c_[0.012 * np.sin(2 * s) - 0.005, 0.01 * np.cos(2.5 * s), 0.06 * s - 0.03] + [shift.get(x, 0.0)
                                                                                            for x in 'xyz']


def test_lines_that_are_one_curve_come_first_and_say_where_it_is():
    a, b = seen(device(), VIEWS[0]), seen(device(), VIEWS[1])
    other_a, other_b = seen(device(z=0.02), VIEWS[0], 0.5), seen(device(z=-0.02)[::2] * [1, -1, 1], VIEWS[1], 0.5)
    first, *rest = by_lines(VIEWS, ([other_a, a], [b, other_b]))
    assert first.lines == (a, b) and first.coarse == 0 and not first.clearing
    assert cKDTree(device()).query(first.curve)[0].max() < 1e-3
    assert all(h.lines != (a, b) for h in rest)         # read the other way round they do not fit as well


def test_a_line_may_be_given_in_either_direction():
    a, b = (seen(device()[::way], view) for view, way in zip(VIEWS, (1, -1)))
    first, *_ = by_lines(VIEWS, ([a], [b]))
    assert cKDTree(device()).query(first.curve)[0].max() < 1e-3


def test_without_a_line_in_one_plane_there_is_no_pair():
    line = seen(device(), VIEWS[0])
    assert list(by_lines(VIEWS, ([line], []))) == list(by_lines(VIEWS, ([], [line]))) == []


def test_lines_that_share_no_epipolar_lines_are_no_pair():
    low, high = (seen(0.4 * device() + [0, 0, z], view) for view, z in zip(VIEWS, (-0.04, 0.04)))
    assert not list(by_lines(VIEWS, ([low], [high])))


def test_lines_along_epipolar_lines_are_read_both_ways():
    scene = families()['tangent'].make(10027).scene
    found = [[seen(scene.truth, v)] for v in scene.frame.views]
    curves = [h.curve for h in by_lines(scene.frame.views, found)]
    assert len(curves) == 2 and min(cKDTree(scene.truth).query(c)[0].max() for c in curves) < 2e-3
    assert cKDTree(curves[0]).query(curves[1])[0].max() > 5e-3


def test_lines_are_undistorted_before_they_are_compared(monkeypatch):
    asked = []
    monkeypatch.setattr('fluoro_shape_ros.method.propose.lines.undistort',
                        lambda view, px: asked.append(view) or undistort(view, px))
    a, b = (seen(device(), v) for v in VIEWS)
    assert_array_equal(next(by_lines(VIEWS, ([a], [b]))).lines, (a, b))
    assert asked == list(VIEWS)
