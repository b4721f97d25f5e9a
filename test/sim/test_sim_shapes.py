"""Robot shapes: arcs by hand, arc length, bounds, motion."""

import numpy as np
import pytest

from fluoro_shape_ros.geometry.curve import arc_length, curvature
from fluoro_shape_ros.sim import shapes
from fluoro_shape_ros.sim.shapes import Cannula, Pose, Spline

QUARTER = np.pi / 2


def quarter_circles(outer_rotation, inner_rotation):
    """Both sections turn by 90 degrees, with radii of 30 and 20 mm."""
    return Cannula(0.03 * QUARTER, 1 / 0.03, outer_rotation, 0.02 * QUARTER, 1 / 0.02, inner_rotation)


RANDOM = [make(np.random.default_rng(seed), length) for seed in range(6)
          for make, length in ((shapes.random_spline, 0.13), (shapes.random_cannula, 0.1))]


@pytest.mark.parametrize('cannula, tip_mm', [
    (Cannula(0.05, 0.0, 0.0, 0.02 * QUARTER, 1 / 0.02, 0.0), (70, 20, 0)),
    (Cannula(0.05, 0.0, 0.0, 0.02 * QUARTER, 1 / 0.02, QUARTER), (70, 0, 20)),
    (quarter_circles(0.0, 0.0), (10, 50, 0)),           # on around: half a turn in one plane
    (quarter_circles(0.0, np.pi), (50, 50, 0)),         # back again: an S
    (quarter_circles(0.0, QUARTER), (30, 50, 20)),      # out of the plane
    (quarter_circles(QUARTER, QUARTER), (10, 0, 50)),
    (Cannula(0.03, 0.0, 1.0, 0.02, 0.0, 2.0), (50, 0, 0)),
])
def test_cannula_tip_by_hand(cannula, tip_mm):
    np.testing.assert_allclose(cannula.backbone()[-1] * 1000, tip_mm, atol=1e-6)


def test_cannula_sections_are_arcs():
    points = quarter_circles(0.0, QUARTER).backbone()
    bend = curvature(points)
    joint = round(0.03 * QUARTER / shapes.STEP)
    np.testing.assert_allclose(bend[:joint - 2], 1 / 0.03, rtol=1e-3)
    np.testing.assert_allclose(bend[joint + 1:], 1 / 0.02, rtol=1e-3)


def test_spline_of_even_turning_is_a_circle():
    k, knots = 20.0, np.arange(6) * shapes.KNOT_SPACING
    tip = Spline(0.11, np.c_[k * knots, 0 * knots]).backbone()[-1]
    np.testing.assert_allclose(tip, [np.sin(k * 0.11) / k, (1 - np.cos(k * 0.11)) / k, 0], atol=1e-9)


def test_straight_spline_follows_its_heading():
    heading = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])     # x to y, y to z
    points = Spline(0.1, np.zeros((5, 2)), Pose(np.array([1.0, 2.0, 3.0]), heading)).backbone()
    np.testing.assert_allclose(points[[0, -1]], [[1, 2, 3], [1, 2.1, 3]], atol=1e-12)


@pytest.mark.parametrize('shape', RANDOM)
def test_steps_are_equal_and_length_is_exact(shape):
    points = shape.backbone()
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.ptp(steps) < 1e-8
    assert arc_length(points)[-1] == pytest.approx(shape.length, rel=1e-5)


@pytest.mark.parametrize('shape', RANDOM)
def test_nothing_bends_tighter_than_allowed_even_while_moving(shape):
    tightest = [curvature(shapes.moving(shape, t).backbone(5e-4)).max() for t in np.linspace(0, 20, 9)]
    assert max(tightest) < shapes.MAX_CURVATURE * 1.001
    assert max(tightest) > 0.2 * shapes.MAX_CURVATURE       # but it does bend


def test_a_hook_is_bent_by_its_end_and_never_too_tightly():
    for seed in range(20):
        hook = shapes.random_hook(np.random.default_rng(seed), 0.1)
        points = hook.backbone(5e-4)
        along = np.linspace(0, hook.length, len(points))[1:-1]
        inner = along - hook.outer_length
        shaft, end = (curvature(points)[m] for m in (inner < -1e-3, inner > 1e-3))
        assert shaft.max() < end.min() and end.max() < shapes.HOOK_CURVATURE * 1.001
        turned = np.degrees(hook.inner_curvature * hook.inner_length)
        assert 45 <= turned <= 170 or hook.inner_curvature == shapes.HOOK_CURVATURE


@pytest.mark.parametrize('shape', RANDOM)
def test_motion_starts_as_drawn_stands_at_its_base_and_is_slow(shape):
    still = shape.backbone()
    np.testing.assert_array_equal(shapes.moving(shape, 0.0).backbone(), still)
    tips = np.array([shapes.moving(shape, t).backbone()[-1] for t in np.arange(0, 8, 0.1)])
    bases = np.array([shapes.moving(shape, t).backbone()[0] for t in np.arange(0, 8, 1.0)])
    np.testing.assert_allclose(bases, np.tile(still[0], (len(bases), 1)), atol=1e-12)
    travel = np.linalg.norm(np.diff(tips, axis=0), axis=1) / 0.1
    assert 0.002 < travel.max() < 0.1      # m/s
    assert max(shapes.moving(shape, t).length for t in np.arange(0, 8, 0.1)) <= shape.length


def test_the_same_seed_gives_the_same_shape():
    first, again, other = (shapes.random_spline(np.random.default_rng(seed), 0.1).backbone() for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_a_length_below_the_step_is_refused():
    with pytest.raises(ValueError, match='can not be cut'):
        Spline(5e-5, np.zeros((5, 2))).backbone()
