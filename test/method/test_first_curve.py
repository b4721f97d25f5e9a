"""A first curve in space from two lines that correspond: near enough for the fit to take over."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluoro_shape_ros.geometry.cameras import fundamental, project
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.method.propose.alignment import align
from fluoro_shape_ros.method.propose.first_curve import first_curve
from fluoro_shape_ros.sim.carm import CArm, biplane

PX = 0.3e-3
ARM = CArm(pixel_size_iso=PX, width=512, height=512)
T = np.linspace(0, 1, 800)
CURVES = {
    'straight': np.c_[0.03 * T - 0.015, 0.02 * T - 0.01, 0.06 * T - 0.03],
    'monotone': np.c_[0.01 * np.sin(3 * T), 0.015 * T**2, 0.08 * T - 0.04],
    # its tangents lie in their epipolar planes near the middle
    'tangent': np.c_[0.06 * T - 0.03, 0.01 * T, -0.08 * (T - 0.4)**2],
    'loop': np.c_[0.02 * np.cos(6 * T), 0.02 * np.sin(6 * T) + 0.02 * T, 0.06 * T - 0.03],
}


def first(X, views, flipped=False, noise_px=0.0):
    rng = np.random.default_rng(0)
    a, b = (at_arc_length(px, np.arange(0, arc_length(px)[-1], 1.0)) for px in (project(v.P, X) for v in views))
    a, b = (line + rng.normal(0, noise_px, line.shape) for line in (a, b))
    if flipped:
        b = b[::-1]
    found = next(align([a], [b], [np.ones(1), np.ones(1)], fundamental(views[0].P, views[1].P)))
    return first_curve(views, a, b, found)


def mean_px(X, found):
    """Mean distance in px, of the curve found from the true one and the other way round."""
    return cKDTree(X).query(found)[0].mean() / PX, cKDTree(found).query(X)[0].mean() / PX


@pytest.mark.parametrize('flipped', [False, True])
@pytest.mark.parametrize('name', CURVES)
def test_exact_lines_give_a_start_within_two_px(name, flipped):
    X = CURVES[name]
    found = first(X, biplane(arm=ARM), flipped)
    assert found.shape[1] == 3 and np.isfinite(found).all()
    assert max(mean_px(X, found)) < 2
    assert np.linalg.norm(found[[0, -1]] - X[[0, -1]], axis=1).max() < 12 * PX      # in A's order, whatever B's


@pytest.mark.parametrize('angle', np.deg2rad([35, 125]))
def test_planes_need_not_be_square_to_each_other(angle):
    X = CURVES['monotone']
    assert max(mean_px(X, first(X, biplane(angle_b=(angle, 0.2), arm=ARM)))) < 3


def test_jitter_of_the_lines_does_not_matter():
    X = CURVES['monotone']
    assert max(mean_px(X, first(X, biplane(arm=ARM), noise_px=0.3))) < 2
