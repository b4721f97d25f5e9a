"""Places that each plane shows by itself, of curves whose projections are known: a mm is a px at the isocentre."""

from dataclasses import fields, replace

import numpy as np
import pytest
from drawing import GOOD, RADIUS, SIZE, VIEWS

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome
from fluoro_shape_ros.geometry.cameras import epipolar_lines, fundamental, make_view, project
from fluoro_shape_ros.geometry.curve import arc_length
from fluoro_shape_ros.geometry.spline import through
from fluoro_shape_ros.method.fit.result import Fit
from fluoro_shape_ros.method.landmarks import landmarks
from fluoro_shape_ros.method.pipeline import reconstruct

A, B = (make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS))
MM = 1e-3
UP, LEVEL = (np.linspace(-50, 50, 101)[:, None] * MM * np.array(d)
             for d in ([0.0, 0.0, 1.0], [0.5**0.5, 0.5**0.5, 0.0]))     # across epipolar lines, and along one


def fitted(points, seen_at=None, presence=None, offset_px=(0.0, 0.0)):
    """A fit that begins 5 mm inside (N, 3) points and ends 5 mm before their end, with strips every mm."""
    spline, length = through(points, 0.0), arc_length(points)[-1]
    s = np.arange(0, length, MM)
    presence = np.ones((len(s), 2)) if presence is None else presence(s)
    sigma = None if seen_at is None else np.full((2, 2), 0.3 * MM)
    given = dict(spline=spline, start=5 * MM, stop=length - 5 * MM, s=s, presence=presence,
                 offset_px=np.tile(offset_px, (len(s), 1)), seen_at=seen_at, seen_sigma=sigma)
    return Fit(**{field.name: given.get(field.name) for field in fields(Fit)})


def apart(found):
    """(N,) px by which landmarks lie beside their epipolar lines in plane B, and (N,) their standard deviations."""
    lines = epipolar_lines(fundamental(A.P, B.P), found.a_px)
    return (lines[:, :2] * found.b_px).sum(axis=1) + lines[:, 2], np.abs((lines[:, :2] * found.slack_px).sum(axis=1))


@pytest.mark.parametrize('last, kinds', [(True, ('base', 'tip')), (False, ('tip', 'base'))])
def test_ends_that_the_planes_see_at_different_places(last, kinds):
    found = landmarks(fitted(UP, np.array([[4.0, 5.0], [95.0, 96.5]]) * MM), (A, B), last)
    assert found.kinds == kinds
    px, sigma = apart(found)
    np.testing.assert_allclose(np.abs(px), [1.0, 1.5], atol=0.01)
    np.testing.assert_allclose(sigma, 0.3 * 2**0.5, atol=0.01)
    assert found.slack_px[0] @ found.slack_px[1] < 0        # outward at both ends
    np.testing.assert_allclose(found.a_px[0], project(A.P, np.array([0, 0, -46 * MM])), atol=0.01)


def test_beside_the_curve_is_where_the_images_show_them():
    found = landmarks(fitted(UP, np.array([[5.0, 5.0], [95.0, 95.0]]) * MM, offset_px=(0.0, 0.7)), (A, B), True)
    np.testing.assert_allclose(np.linalg.norm(found.b_px - project(B.P, UP[[5, 95]]), axis=1), 0.7, atol=0.01)
    np.testing.assert_allclose(apart(found)[0], 0, atol=0.05)   # along the epipolar lines


def test_an_end_that_one_plane_does_not_tell_is_none():
    nowhere = np.nan
    assert landmarks(fitted(UP, np.array([[nowhere, 5.0], [95.0, 95.0]]) * MM), (A, B), True).kinds == ('tip',)
    assert landmarks(fitted(UP), (A, B), True).kinds == ()
    assert landmarks(fitted(UP), (A, B), True).a_px.shape == (0, 2)


@pytest.mark.parametrize('offset_px, px', [((0.0, 0.4), 0.4), ((0.4, 0.0), 0.4), ((0.0, 0.0), 0.0)])
def test_where_it_runs_along_its_epipolar_line_its_distance_from_the_curve_tells(offset_px, px):
    found = landmarks(fitted(LEVEL, offset_px=offset_px), (A, B), True)
    assert found.kinds == ('bend',) and not found.slack_px.any()
    assert abs(apart(found)[0][0]) == pytest.approx(px, abs=0.02)


def bands(at_mm, moved_mm, dark=0.5):
    bumps = lambda s: 1 + dark * np.exp(-0.5 * ((s[:, None] / MM - at_mm) / 2) ** 2).sum(axis=1)    # noqa: E731
    return lambda s: np.stack([bumps(s), bumps(s - moved_mm * MM)], axis=1)


@pytest.mark.parametrize('moved', [0.0, 1.3, -3.0])
def test_bands_that_the_planes_see_at_different_places(moved):
    found = landmarks(fitted(UP, presence=bands(np.array([35.0, 48.0, 66.0]), moved)), (A, B), True)
    assert found.kinds == ('steps',)
    px, sigma = apart(found)
    at_start = apart(landmarks(fitted(UP, np.array([[5.0, 5.0 + moved], [95.0, 95.0]]) * MM), (A, B), True))[0][0]
    assert (px[0] == pytest.approx(at_start, abs=0.1) and abs(px[0]) == pytest.approx(abs(moved), abs=0.1)
            and sigma[0] == pytest.approx(0.8))


@pytest.mark.parametrize('presence', [bands(np.array([50.0]), 0.0, 0.02), bands(np.array([35.0, 48.0]), 15.0)])
def test_faint_bands_and_those_that_are_not_alike_are_none(presence):
    assert landmarks(fitted(UP, presence=presence), (A, B), True).kinds == ()


def test_a_reconstruction_has_them_and_they_tell_a_shift_that_it_takes_up():
    found = []
    for px in (0.0, 1.0):
        wrong = replace(B, P=B.P + np.outer([0, px, 0], B.P[2]))
        result = reconstruct(Frame(0, 'cell', tuple(GOOD), (A, wrong)), Config.from_values(robot_radius=RADIUS))
        assert result.confidence > 0.5 and {'tip', 'base'} <= set(result.landmarks.kinds)       # refused or not
        assert result.outcome is not Outcome.OK or np.nanmedian(result.shape.residuals_px) < 0.3
        lines = epipolar_lines(fundamental(A.P, wrong.P), result.landmarks.a_px)
        found.append(dict(zip(result.landmarks.kinds,
                              (lines[:, :2] * result.landmarks.b_px).sum(axis=1) + lines[:, 2])))
    for end in ('tip', 'base'):
        assert abs(found[0][end]) < 0.4 and abs(found[1][end] - found[0][end]) == pytest.approx(1.0, abs=0.4)
