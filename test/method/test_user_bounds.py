"""The bounds that a user sets, by hand, and how honest what is left is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.method.backbone import CALIBRATION_PX
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.method.user_bounds import (
    check_curvature,
    check_length,
    check_reprojection,
    check_tip,
    curvature_limit,
)
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

ARC = 0.05 * np.c_[np.cos(np.linspace(0, 1, 9)), np.sin(np.linspace(0, 1, 9)), np.zeros(9)]     # 20 /m


def test_eq_3_limit_is_spacing_times_resolution_in_per_mm():
    # 10 px x 0.523 mm/px = 5.23, read as 5.23 /mm = 5230 /m
    assert_allclose(curvature_limit(Config.from_values(spacing_px=10.0), 0.523e-3), 5230)
    assert curvature_limit(Config.from_values(max_curvature=50.0), 0.523e-3) == 50


def test_curvature():
    assert check_curvature([ARC, ARC[:4]], 21) is None
    outcome, why = check_curvature([ARC[:0], ARC], 19)
    assert outcome is Outcome.CURVATURE and '20 /m exceeds 19 /m' in why


def test_length():
    config = Config.from_values(expected_length=[0.05, 0.1])
    assert check_length(0.07, config) is None and check_length(1.0, Config()) is None
    assert check_length(0.04, config)[0] is check_length(0.11, config)[0] is Outcome.LENGTH


def test_reprojection():
    config = Config.from_values(max_reprojection_px=1.0)
    assert check_reprojection(np.array([[0.5, 0.9], [0.5, 0.9], [9, 9]]), config) is None
    assert check_reprojection(np.array([[0.5, 1.1], [0.5, 1.1]]), config)[0] is Outcome.REPROJECTION


def test_tip_sigma_is_that_of_the_worst_direction():
    turned = Rotation.from_euler('xyz', [0.3, 1.0, -2.0]).as_matrix()
    covariance = turned @ np.diag([1e-8, 4e-8, 9e-8]) @ turned.T            # 0.1, 0.2, 0.3 mm
    assert check_tip(covariance, Config()) is None                          # no limit by default
    assert check_tip(covariance, Config.from_values(max_tip_sigma=0.31e-3)) is None
    outcome, why = check_tip(covariance, Config.from_values(max_tip_sigma=0.29e-3))
    assert outcome is Outcome.TIP_UNCERTAIN and '0.30 mm exceeds 0.29 mm' in why


@pytest.mark.parametrize('covariance', [np.diag([np.inf, 1e-8, 1e-8]), np.full((3, 3), np.inf),
                                        np.full((3, 3), np.nan)],
                         ids=['one way', 'all ways', 'NaN'])
def test_a_tip_nobody_knows_exceeds_every_limit(covariance):
    assert check_tip(covariance, Config.from_values(max_tip_sigma=1.0))[0] is Outcome.TIP_UNCERTAIN
    assert check_tip(covariance, Config()) is None


SCENES = dict(views=biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512)), lengths=(0.06, 0.07),
              anatomy=False)


@pytest.mark.parametrize('kind, seed', [('spline', 0), ('spline', 1), ('tangent', 0), ('tangent', 3)])
def test_half_a_pixel_of_calibration_error_is_borne_or_named(kind, seed):
    scene = xray_run(seed, kind=kind, **SCENES).scene()
    a, b = scene.frame.views
    across_lines = np.array([[1, 0, 0], [0, 1, 0.5], [0, 0, 1]])
    shifted = replace(scene.frame, views=(a, replace(b, P=across_lines @ b.P)))
    result = reconstruct(shifted, Config.from_values(base_position=scene.base_position.tolist()))
    if result.outcome is Outcome.OK:
        assert cKDTree(scene.truth).query(result.shape.points)[0].mean() < 0.33e-3       # 0.3 mm more than without
    else:
        assert result.outcome in (Outcome.REPROJECTION, Outcome.LOW_CONFIDENCE)


def tip_surprise(scene, error_px=(0.0, 0.0)):
    """Squared distance of the tip found from the true one, by its covariance: chi square of 3 degrees of freedom where
    that is honest.

    error_px: (2, 2) u and v by which the calibration of each plane is off.
    """
    views = tuple(replace(v, P=v.P + np.outer([*e, 0.0], v.P[2]))
                  for v, e in zip(scene.frame.views, np.broadcast_to(error_px, (2, 2))))
    shape = reconstruct(replace(scene.frame, views=views),
                        Config.from_values(base_position=scene.base_position.tolist())).shape
    error = shape.tip - scene.truth[-1]
    return float(error @ np.linalg.solve(shape.covariance[-1], error))


def test_the_tip_is_as_certain_as_it_says():
    errors_px = np.random.default_rng(5).normal(0, CALIBRATION_PX, (14, 2, 2))      # as good as a calibration gets
    square = [tip_surprise(xray_run(seed, **SCENES).scene(), error) for seed, error in enumerate(errors_px)]
    assert np.mean(np.less(square, 7.81)) >= 0.85, square       # 95 % of chi square; 12 of 14 at least
    assert 0.5 < np.median(square) < 4                          # 2.4 is due


def test_a_tip_that_one_plane_sees_foreshortened_is_as_certain_as_it_says():
    run = xray_run(4, **SCENES)   # 23 degrees off plane B's ray: its end is a ramp there, 3 px long
    square = [tip_surprise(run.scene(index=k)) for k in range(9)]
    assert np.mean(square) < 6, square                          # 3 +- 0.8 is due
