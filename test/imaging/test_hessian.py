"""Hessian and eigenvalues against polynomials and drawings."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.imaging.hessian import eigenvalues, hessian

V, U = np.mgrid[0:41, 0:41].astype(np.float32) - 20


@pytest.mark.parametrize('sigma', [0.8, 1.5, 3.0])
def test_hessian_of_a_parabola_is_exact(sigma):
    uu, uv, vv = hessian((1.5 * U**2 + 2 * U * V - 0.5 * V**2 + 3 * U + 7).astype(np.float32), sigma)
    assert_allclose([h[20, 20] for h in (uu, uv, vv)], [3, 2, -1], atol=1e-3)


def test_hessian_of_a_constant_is_zero():
    assert max(np.abs(h).max() for h in hessian(np.full((30, 30), 200, np.float32), 2.0)) < 1e-3


def test_eigenvalues_by_hand():
    # [[2, 0], [0, -3]] -> 2, -3; [[0, 1], [1, 0]] -> +-1; [[5, 4], [4, 5]] -> 1, 9
    l1, l2 = eigenvalues(np.float32([2, 0, 5]), np.float32([0, 1, 4]), np.float32([-3, 0, 5]))
    assert_allclose(l1[[0, 2]], [2, 1], atol=1e-6)
    assert_allclose(l2[[0, 2]], [-3, 9], atol=1e-6)
    assert_allclose(abs(l2[1]), 1, atol=1e-6)


def test_dark_line_has_a_large_positive_second_eigenvalue_whatever_its_direction():
    image = np.full((41, 41), 200, np.float32)
    image[19:22] = 100
    for rotated in (image, image.T):
        l1, l2 = eigenvalues(*hessian(rotated, 1.5))
        assert l2[20, 20] > 10 and abs(l1[20, 20]) < 1e-2
    l1, l2 = eigenvalues(*hessian(-image, 1.5))
    assert l2[20, 20] < -10
