"""Two-view geometry against hand-derived answers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.data import Distortion
from fluoro_shape_ros.geometry.cameras import (
    GeometryError,
    calibration_covariance,
    check_pair,
    check_scale,
    crop,
    decompose,
    depth,
    distort,
    epipolar_lines,
    fundamental,
    isocenter,
    make_view,
    pixels_per_metre,
    plane_angle,
    project,
    projection_jacobian,
    source,
    triangulate,
    undistort,
)

K = np.array([[1000.0, 0, 50], [0, 1000.0, 40], [0, 0, 1]])
# plane A looks along +z from z = -1, plane B along +x from x = -1
Pa = K @ np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])
Pb = K @ np.array([[0, 0, -1.0, 0], [0, 1, 0, 0], [1, 0, 0, 1]])
A, B = make_view('a', Pa, 101, 81), make_view('b', Pb, 101, 81)


def test_projection_by_hand():
    assert_allclose(project(A.P, np.array([[0.01, 0.02, 0.0], [0.0, 0.0, 1.0]])), [[60, 60], [50, 40]])
    assert_allclose(depth(A.P, np.array([[0, 0, 0.5], [0, 0, -2.0]])), [1.5, -1.0])


def test_scale_of_p_does_not_matter():
    assert_allclose(make_view('a', 7 * Pa, 101, 81).P, A.P)


def test_jacobian_is_the_derivative_of_project():
    X, h = np.array([0.01, -0.02, 0.03]), 1e-6
    numeric = np.stack([(project(B.P, X + h * e) - project(B.P, X - h * e)) / (2 * h) for e in np.eye(3)], axis=1)
    assert_allclose(projection_jacobian(B.P, X[None])[0], numeric, rtol=1e-6)


def test_what_displaced_planes_do_to_a_curve_by_hand():
    # at the origin, 1 m from both sources, a px is 1 mm. A curve along y: plane A shifts it along x, plane B along z,
    # both together along y
    found = calibration_covariance((A, B), np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), 0.5)[0]
    assert_allclose(found, np.diag([0.25e-6, 0.125e-6, 0.25e-6]), rtol=0.06, atol=1e-12)


def test_displaced_planes_shift_a_slanting_curve_by_as_much_as_it_takes_to_see_it_there():
    tangent, rng, sigma_px = np.array([0.5, 1.0, 0.6]), np.random.default_rng(1), 0.5
    Ja, Jb = (projection_jacobian(P, np.zeros((1, 3)))[0] for P in (A.P, B.P))
    moved = []
    for da, db in rng.normal(0, sigma_px, (4000, 2, 2)):
        rows, seen, ends = [], [], []
        for J, d in ((Ja, da), (Jb, db)):
            step = J @ tangent
            n, t = np.array([-step[1], step[0]]) / np.linalg.norm(step), step / (step @ step)
            rows.append(n @ J)
            seen.append(n @ d)
            ends.append((t @ J, t @ d))         # in units of the tangent
        moved.append(np.linalg.solve([*rows, ends[0][0] + ends[1][0]], [*seen, ends[0][1] + ends[1][1]]))
    found = calibration_covariance((A, B), np.zeros((1, 3)), tangent[None], sigma_px)[0]
    assert_allclose(np.sqrt(np.linalg.eigvalsh(found)), np.sqrt(np.linalg.eigvalsh(np.cov(np.array(moved).T))),
                    rtol=0.06)


@pytest.mark.parametrize('distortion',
                         [None, Distortion('plumb_bob', K, np.array([0.3, -0.1, 0.001, 0.002, 0.0]), np.eye(3))])
def test_a_cropped_view_counts_its_pixels_from_its_own_corner(distortion):
    whole = make_view('b', Pb, 101, 81, distortion)
    part = crop(whole, slice(20, 71), slice(10, 91))
    assert (part.width, part.height) == (81, 51)
    X = np.array([[0.0, 0.01, 0.02], [0.01, -0.01, -0.03]])
    seen = distort(whole, project(whole.P, X))
    assert_allclose(distort(part, project(part.P, X)), seen - [10, 20], atol=1e-9)
    assert_allclose(undistort(part, seen - [10, 20]), project(part.P, X), atol=1e-4)


def test_decompose_gives_back_k_and_pose():
    k, R, t = decompose(A.P)
    assert_allclose(k, K, atol=1e-9)
    assert_allclose(R, np.eye(3), atol=1e-12)
    assert_allclose(t, [0, 0, 1], atol=1e-12)


def test_mirrored_image_decomposes_with_negative_focal_length():
    k, R, t = decompose(np.diag([-1.0, 1, 1]) @ Pa)
    assert k[0, 0] < 0 < k[1, 1]
    assert_allclose(np.linalg.det(R), 1)
    assert_allclose(k @ np.c_[R, t], np.diag([-1.0, 1, 1]) @ Pa, atol=1e-9)


def test_source_angle_isocenter_magnification():
    assert_allclose(source(A.P), [0, 0, -1], atol=1e-12)
    assert_allclose(plane_angle((A, B)), np.pi / 2)
    assert_allclose(isocenter((A, B)), [0, 0, 0], atol=1e-9)
    assert_allclose(pixels_per_metre(A.P, np.zeros((1, 3))), 1000)


def test_corresponding_points_lie_on_epipolar_lines():
    X = np.random.default_rng(0).uniform(-0.02, 0.02, (20, 3))
    a, b = project(A.P, X), project(B.P, X)
    F = fundamental(A.P, B.P)
    for F_, p, q in ((F, a, b), (F.T, b, a)):
        assert_allclose(np.einsum('ni,ni->n', epipolar_lines(F_, p), np.c_[q, np.ones(20)]), 0, atol=1e-9)


def test_epipolar_line_by_hand():
    # The plane through both sources and the isocentre is y = 0: row v = 40 in both images.
    line = epipolar_lines(fundamental(A.P, B.P), np.array([[50.0, 40.0]]))[0]
    assert_allclose(abs(line), [0, 1, 40], atol=1e-9)


def test_triangulation_is_exact_without_noise():
    X = np.random.default_rng(1).uniform(-0.02, 0.02, (50, 3))
    assert_allclose(triangulate(A.P, B.P, project(A.P, X), project(B.P, X)), X, atol=1e-12)


def test_triangulation_minimises_the_reprojection_error():
    rng = np.random.default_rng(2)
    X = rng.uniform(-0.02, 0.02, (10, 3))
    a, b = project(A.P, X) + rng.normal(0, 1, (10, 2)), project(B.P, X) + rng.normal(0, 1, (10, 2))

    def cost(Y):
        return ((project(A.P, Y) - a) ** 2 + (project(B.P, Y) - b) ** 2).sum(1)
    Y = triangulate(A.P, B.P, a, b)
    for d in np.r_[np.eye(3), -np.eye(3)] * 1e-6:
        assert (cost(Y + d) > cost(Y)).all()


def test_triangulation_answers_nan_for_unusable_pixels():
    Y = triangulate(A.P, B.P, np.array([[50.0, 40.0], [np.nan, 1.0]]), np.array([[50.0, 40.0], [1.0, 1.0]]))
    assert_allclose(Y[0], 0, atol=1e-9)
    assert np.isnan(Y[1]).all()


@pytest.mark.parametrize('P, reason', [
    (np.zeros((3, 4)), 'zero or singular'), (np.full((3, 4), np.nan), 'finite'), (np.eye(3), '3x4'),
    (np.r_[Pa[:2], [[0, 0, 0, 1.0]]], 'zero or singular'),
    (np.eye(3, 4) * 1e-3 + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]], 'focal length')])
def test_what_cannot_be_a_camera_is_named(P, reason):
    with pytest.raises(GeometryError, match=f'plane a.*{reason}'):
        make_view('a', P, 101, 81)


def test_planes_that_see_no_depth_are_named():
    with pytest.raises(GeometryError, match='coincide'):
        check_pair((A, make_view('b', Pa, 101, 81)))
    shifted = Pa.copy()
    shifted[:, 3] += K @ [0.005, 0, 0]
    with pytest.raises(GeometryError, match='parallel'):
        check_pair((A, make_view('b', shifted, 101, 81)))
    with pytest.raises(GeometryError, match='parallel'):     # sources that face each other
        check_pair((A, make_view('b', K @ np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 1]]), 101, 81)))
    check_pair((A, B))


@pytest.mark.parametrize('z', [0.0, 1.0, -2.5])
def test_a_stereo_pair_looks_to_where_its_images_are_a_quarter_apart_whatever_the_frame(z):
    # 0.1 m apart: 1000 px * 0.1 m / distance = 101 px / 4
    pair = tuple(make_view(name, K @ np.array([[1.0, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, z]]), 101, 81)
                 for name, x in (('a', 0.0), ('b', -0.1)))
    check_pair(pair)
    check_scale(pair, 0.001)
    assert_allclose(isocenter(pair), [0.05, 0, 400 / 101 - z], atol=1e-9)


def test_a_source_where_the_planes_look_is_named():
    """The device would be a quarter as wide as the image, and filters without end be made for it: 1000 px a radian, 81
    px high, radius 10.125 mm at 1 m."""
    check_scale((A, B), 0.0101)
    with pytest.raises(GeometryError, match='plane a: a device of radius 10.2 mm would be 20.4 px wide'):
        check_scale((A, B), 0.0102)
    here = make_view('b', K @ np.array([[0, 0, -1.0, 0], [0, 1, 0, 0], [1, 0, 0, 0]]), 101, 81)
    with pytest.raises(GeometryError, match='plane b: .* px wide'):
        check_scale((A, here), 0.0006)


def test_a_device_less_than_a_tenth_of_a_pixel_wide_asks_for_metres():
    check_scale((A, B), 0.000051)
    with pytest.raises(GeometryError, match='is P in metres'):
        check_scale((A, B), 0.000049)


@pytest.mark.parametrize('model, D', [('plumb_bob', [-0.2, 0.05, 1e-3, -2e-3, 0.01]),
                                      ('rational_polynomial', [0.3, 0.1, 0, 0, 0.02, 0.1, 0.05, 0.01]),
                                      ('equidistant', [0.02, -0.01, 0.003, 0.0])])
def test_distortion_is_removed_and_put_back(model, D):
    view = make_view('a', Pa, 101, 81, Distortion(model, K, np.array(D), np.eye(3)))
    px = np.array([[0.0, 0], [100, 80], [50, 40], [20, 70]])
    ideal = undistort(view, px)
    assert_allclose(ideal[2], [50, 40], atol=1e-9)       # the principal point stays
    assert np.abs(ideal - px).max() > 1e-3
    assert_allclose(distort(view, ideal), px, atol=1e-5)


def test_plumb_bob_by_hand():
    # radial k1 only: x_d = x (1 + k1 r^2); at x = 0.05, k1 = 2: 0.05 * 1.005 = 0.05025 -> u = 100.25
    view = make_view('a', Pa, 101, 81, Distortion('plumb_bob', K, np.array([2.0, 0, 0, 0, 0]), np.eye(3)))
    assert_allclose(distort(view, np.array([[100.0, 40.0]])), [[100.25, 40]], atol=1e-9)
    assert_allclose(undistort(view, np.array([[100.25, 40.0]])), [[100, 40]], atol=1e-6)


def test_rectifying_rotation_is_applied():
    c, s = np.cos(0.01), np.sin(0.01)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    view = make_view('a', Pa, 101, 81, Distortion('plumb_bob', K, np.zeros(5), R))
    assert_allclose(undistort(view, np.array([[50.0, 40.0]])), [[50 + 1000 * np.tan(0.01), 40]], atol=1e-6)
