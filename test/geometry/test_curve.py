"""Arc length, resampling and curvature against closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.geometry.curve import (
    arc_length,
    arcs,
    at_arc_length,
    curvature,
    distance_to,
    even_steps,
    resample,
)


def circle(radius, angle, n):
    t = np.linspace(0, angle, n)
    return np.c_[radius * np.cos(t), radius * np.sin(t), np.zeros(n)]


def test_arcs_by_hand():
    start, x, quarter = np.array([[1.0, 2, 3]] * 2), np.array([[1.0, 0, 0]] * 2), np.pi / 2
    points, tangents = arcs(start, x, np.array([[0.0, 0.5, 0], [0, 0, 0]]), np.array([0.0, 2 * quarter]))
    assert_allclose(points, [[[1, 2, 3], [3, 4, 3]], [[1, 2, 3], [1 + 2 * quarter, 2, 3]]], atol=1e-12)
    assert_allclose(tangents, [[[1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 0, 0]]], atol=1e-12)


def test_arc_length_by_hand():
    assert_allclose(arc_length(np.array([[0.0, 0], [3, 4], [3, 5]])), [0, 5, 6])
    assert_allclose(at_arc_length(np.array([[0.0, 0], [3, 4], [3, 5]]), np.array([2.5, 5.5])), [[1.5, 2], [3, 4.5]])


@pytest.mark.parametrize('length, steps', [(0.0025, [0, 0.001, 0.002, 0.0025]), (0.003, [0, 0.001, 0.002, 0.003]),
                                           (0.0005, [0, 0.0005])])
def test_only_the_last_step_is_shorter(length, steps):
    assert_allclose(even_steps(length, 0.001), steps, atol=1e-12)


def test_resampling_a_quarter_circle():
    points, s = resample(circle(0.05, np.pi / 2, 12), 0.001)
    assert_allclose(s[-1], 0.05 * np.pi / 2, rtol=1e-4)
    assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1)[:-1], 0.001, rtol=1e-3)
    assert_allclose(np.linalg.norm(points, axis=1), 0.05, rtol=1e-3)
    assert_allclose(points[-1], circle(0.05, np.pi / 2, 12)[-1], atol=1e-12)


def test_resampling_two_points_is_a_straight_line():
    points, s = resample(np.array([[0.0, 0, 0], [0, 0, 0.0035]]), 0.001)
    assert_allclose(points[:, 2], [0, 0.001, 0.002, 0.003, 0.0035])


def test_curvature_of_a_circle_and_of_a_line():
    assert_allclose(curvature(circle(0.05, 1.0, 30)), 20, rtol=1e-9)
    assert_allclose(curvature(np.outer(np.arange(5.0), [1, 2, 3])), 0, atol=1e-12)


def test_distance_to_a_polyline_by_hand():
    corner = np.array([[0.0, 0], [10, 0], [10, 10]])
    assert_allclose(distance_to(np.array([[4.0, 3], [12, 5], [13, -4], [-3, 4]]), corner), [3, 2, 5, 5])
