"""Every doubt by hand."""

import numpy as np
from numpy.testing import assert_allclose

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.plausibility import check_curvature, check_length, check_reprojection, curvature_limit

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
