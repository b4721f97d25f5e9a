"""Two views of points: what holds for any cameras and any points, sensible or not."""

import numpy as np
import pytest

pytest.importorskip('hypothesis')

from generated import examples
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.data import Distortion
from fluoro_shape_ros.geometry.cameras import (
    GeometryError,
    check_pair,
    decompose,
    depth,
    distort,
    epipolar_lines,
    fundamental,
    make_view,
    plane_angle,
    project,
    projection_jacobian,
    source,
    triangulate,
    undistort,
)

SIZE = 1024
UNIT = st.floats(-1, 1)
ANGLE = st.floats(0, 2 * np.pi)
# within 0.1 m of the isocentre, per axis
POINTS = st.lists(st.tuples(UNIT, UNIT, UNIT), min_size=1, max_size=8).map(lambda p: 0.1 * np.array(p))
ANY_PX = st.one_of(st.floats(width=64), st.floats(-2000, 2000))


def view(name, angle, tilt=0.0, roll=0.0, distance=0.8, mirrored=False, f=2000.0):
    """A source at `distance` (m) from the origin that looks at it."""
    K = np.array([[-f if mirrored else f, 0, SIZE / 2], [0, f, SIZE / 2], [0, 0, 1.0]])
    R = Rotation.from_euler('zxy', [roll, tilt, angle]).as_matrix()
    return make_view(name, K @ np.c_[R, [0, 0, distance]], SIZE, SIZE)


@st.composite
def biplane(draw):
    """A pair of views 30 to 150 degrees apart, either of which may be mirrored."""
    first, apart = draw(ANGLE), draw(st.floats(np.pi / 6, 5 * np.pi / 6))
    return tuple(view(name, angle, draw(st.floats(-0.3, 0.3)), draw(ANGLE), draw(st.floats(0.5, 1.2)),
                      draw(st.booleans()))
                 for name, angle in (('a', first), ('b', first + apart)))


@examples(2)
@given(biplane(), POINTS)
def test_what_is_seen_twice_is_found_again(views, X):
    assume(plane_angle(views) > np.pi / 9)
    check_pair(views)
    Pa, Pb = (v.P for v in views)
    a, b = project(Pa, X), project(Pb, X)
    assert np.allclose(triangulate(Pa, Pb, a, b), X, atol=1e-7)
    lines = epipolar_lines(fundamental(Pa, Pb), a)
    assert np.abs((lines[:, :2] * b).sum(axis=1) + lines[:, 2]).max() < 1e-5     # px


@examples(2)
@given(biplane(), POINTS)
def test_mirroring_an_image_moves_no_point(views, X):
    assume(plane_angle(views) > np.pi / 9)
    flip = np.array([[-1.0, 0, SIZE - 1], [0, 1, 0], [0, 0, 1]])
    mirrored = make_view('a', flip @ views[0].P, SIZE, SIZE)
    assert (np.allclose(source(mirrored.P), source(views[0].P))
            and np.sign(decompose(mirrored.P)[0][0, 0]) == -np.sign(decompose(views[0].P)[0][0, 0]))
    a, b = project(mirrored.P, X), project(views[1].P, X)
    assert np.allclose(a[:, 0], SIZE - 1 - project(views[0].P, X)[:, 0])
    assert np.allclose(triangulate(mirrored.P, views[1].P, a, b), X, atol=1e-7)


@examples()
@given(ANGLE, st.floats(-0.02, 0.02), st.floats(-1e-4, 1e-4), st.booleans())
def test_planes_that_see_no_depth_are_refused(angle, tilt, step, mirrored):
    with pytest.raises(GeometryError, match='coincide|parallel'):
        check_pair((view('a', angle), view('b', angle, tilt / 10, distance=0.8 + step, mirrored=mirrored)))


# rays on which a Newton step met a singular matrix, and the whole lot was lost
MET_NOWHERE = (make_view('a', [[1602.28723, 1196.94429, 512.0, 256.0], [1196.94429, -1602.28723, 512.0, 256.0],
                               [0, 0, 1, 0.5]], SIZE, SIZE),
               make_view('b', [[396.676428, 1263.5092, -1583.77281, 512.0],
                               [2046.54436, -158.316583, 220.762377, 512.0],
                               [0.270259376, 0.860840683, 0.431176517, 1.0]], SIZE, SIZE))


@examples(2)
@example(MET_NOWHERE, [(0.0, -890.0, -356.0, 1948.0)])
@given(biplane(), st.lists(st.tuples(ANY_PX, ANY_PX, ANY_PX, ANY_PX), max_size=6))
def test_any_pixels_triangulate_to_points_or_nothing(views, pixels):
    """NaN, infinity, rays that never meet or meet behind the source: a finite point or NaN each, and none spoils
    another."""
    px = np.array(pixels, float).reshape(-1, 4)
    Pa, Pb = (v.P for v in views)
    good = np.r_[project(Pa, np.zeros((1, 3)))[0], project(Pb, np.zeros((1, 3)))[0]]
    X = triangulate(Pa, Pb, np.vstack([px, good])[:, :2], np.vstack([px, good])[:, 2:])
    assert X.shape == (len(px) + 1, 3)
    assert (np.isfinite(X).all(axis=1) | np.isnan(X).all(axis=1)).all()
    assert np.isnan(X[:-1][~np.isfinite(px).all(axis=1)]).all()


@examples()
@given(biplane(), POINTS, st.floats(0, 1))
def test_a_point_behind_the_source_or_in_its_plane_is_known_by_its_depth(views, X, beyond):
    P = views[0].P
    behind = 2 * source(P) - X          # mirrored at the source: on the same rays
    assert np.allclose(project(P, behind), project(P, X), atol=1e-6) and np.allclose(depth(P, behind), -depth(P, X))
    across = source(P) + np.cross(P[2, :3], np.eye(3)[np.abs(P[2, :3]).argmin()]) * (beyond + 0.1)
    seen = project(P, across)
    assert abs(depth(P, across)) < 1e-9 and not (np.isfinite(seen).all() and (np.abs(seen) < 1e6).all())


@examples()
@given(biplane(), POINTS)
def test_the_jacobian_is_the_derivative(views, X):
    P, h = views[0].P, 1e-6
    numeric = np.stack([(project(P, X + h * e) - project(P, X - h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
    assert np.allclose(projection_jacobian(P, X), numeric, rtol=1e-4, atol=1e-2)


@examples()
@given(st.sampled_from([('plumb_bob', 5), ('rational_polynomial', 8), ('equidistant', 4)]),
       st.lists(st.floats(-0.02, 0.02), min_size=8, max_size=8), ANGLE,
       st.lists(st.tuples(st.floats(0, SIZE - 1), st.floats(0, SIZE - 1)), max_size=6))
def test_removing_distortion_is_undone_by_putting_it_back(model, D, angle, pixels):
    name, count = model
    plain = view('a', angle)
    K, _, _ = decompose(plain.P)
    bent = make_view('a', plain.P, SIZE, SIZE, Distortion(name, K, np.array(D[:count]), np.eye(3)))
    px = np.array(pixels, float).reshape(-1, 2)
    assert np.allclose(distort(bent, undistort(bent, px)), px, atol=0.01)
