"""The published method's steps on hand-made cases."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import wiener as scipy_wiener

from fluoro_shape_ros.geometry.cameras import make_view, project
from fluoro_shape_ros.method import paper

K = np.array([[1000.0, 0, 128], [0, 1000.0, 128], [0, 0, 1]])
A = make_view('a', K @ np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]]), 257, 257)
B = make_view('b', K @ np.array([[0, 0, -1.0, 0], [0, 1, 0, 0], [1, 0, 0, 1]]), 257, 257)


def test_wiener_keeps_a_constant_and_smooths_noise():
    assert_allclose(paper.wiener(np.full((20, 20), 5, np.float32)), 5)
    image = np.random.default_rng(0).normal(100, 2, (64, 64)).astype(np.float32)
    assert paper.wiener(image).std() < image.std() / 1.4


def test_wiener_agrees_with_scipy_inside():
    image = np.random.default_rng(1).normal(100, 5, (40, 40)).astype(np.float32)
    image[10:20, 10:20] += 40
    box = np.lib.stride_tricks.sliding_window_view(np.pad(image, (3, 2), mode='symmetric'), (6, 6))
    noise = box.var(axis=(2, 3)).mean()
    # SciPy pads with zeros, so only the inside can agree
    assert_allclose(paper.wiener(image)[8:-8, 8:-8], scipy_wiener(image.astype(float), 6, noise)[8:-8, 8:-8], rtol=1e-3)


def test_eq_2_by_hand():
    # A parabolic trough I = c u^2 / 2 + 1: l2 = c sigma^2, l1 = 0, R = 0, S = l2^2, max(I) = 1 + 200 c
    u = np.mgrid[0:41, 0:41][1] - 20.0
    c = 0.01
    image = (c * u**2 / 2 + 1).astype(np.float32)
    S, beta_2 = (c * 4) ** 2, 2 * (image.max() / 4) ** 2
    assert_allclose(paper.vesselness(image, [2.0])[20, 20], 1 - np.exp(-S / beta_2), rtol=1e-3)
    assert paper.vesselness(-image, [2.0])[20, 20] == 0      # l2 < 0: a bright ridge is not a dark device


def test_skeleton_path_of_a_t():
    skeleton = np.zeros((20, 30), bool)
    skeleton[10, 3:27] = True
    skeleton[5:10, 12] = True                                # a spur, shorter than either arm
    path = paper.longest_curve(skeleton, 5)
    assert {tuple(path[0]), tuple(path[-1])} == {(3.0, 10.0), (26.0, 10.0)}
    assert (path[:, 1] == 10).all() and len(path) == 24
    assert len(paper.longest_curve(skeleton, 40)) == 0


def test_blank_skeleton_has_no_path():
    assert paper.longest_curve(np.zeros((5, 5), bool), 1).shape == (0, 2)


def test_control_points_are_even_and_keep_both_ends():
    points = paper.control_points(np.array([[0.0, 0], [95, 0]]), 10)
    assert_allclose(points[[0, -1]], [[0, 0], [95, 0]])
    assert_allclose(np.diff(points[:, 0]), 95 / 10, atol=1)


def test_segmentation_finds_a_dark_line():
    rng = np.random.default_rng(3)
    image = np.full((200, 200), 180, np.float32)
    image[99:102, 30:171] = 60
    image += rng.normal(0, 0.5, image.shape)
    line = paper.segment(image, 1.5, 60)
    assert len(line) > 100
    assert np.abs(np.median(line[:, 1]) - 100) <= 1


def backbone(n=200):
    s = np.linspace(0, 1, n)
    return np.c_[0.03 * np.sin(2 * s), 0.08 * s - 0.04, 0.02 * s**2]


@pytest.mark.parametrize('flip', [False, True])
def test_exact_centerlines_give_the_curve_back_from_either_image(flip):
    X = backbone()
    b = project(B.P, X)
    for curve in paper.reconstruct_curves((A, B), (project(A.P, X), b[::-1] if flip else b), 10.0):
        near = np.linalg.norm(curve[:, None] - X, axis=2).min(axis=1)
        assert len(curve) >= 8 and near.max() < 3e-4


def test_half_width_at_the_isocentre():
    from fluoro_shape_ros.config import Config
    assert_allclose(paper.half_width_px((A, B), Config.from_values(robot_radius=0.002)), [2, 2])
