"""Markers against hand-derived numbers, made with rclpy's and with rosbags' messages."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.data import Shape
from msg_adapters.markers import (
    LIFETIME_S,
    NAMES,
    SIDES,
    rejection_to_markers,
    shape_to_markers,
    sigma_colours,
    tube_mesh,
)
from msg_adapters.messages import stamp_ns

ADD, DELETE = 0, 2
SPHERE, TEXT, TRIANGLES = 2, 9, 11      # visualization_msgs/Marker
RADIUS = 0.0006
CHI2_3 = 7.8147                         # 95 % quantile of chi square with 3 degrees of freedom


def arc(n=101, covariance=None):
    """A quarter of a circle of 5 cm, from +x towards +y."""
    t = np.linspace(0, np.pi / 2, n)
    points = 0.05 * np.c_[np.cos(t), np.sin(t), np.zeros(n)]
    covariance = np.tile(1e-8 * np.eye(3), (n, 1, 1)) if covariance is None else np.tile(covariance, (n, 1, 1))
    return Shape(points, 0.05 * t, covariance, np.zeros((n, 2)))


def test_every_vertex_of_the_tube_is_a_radius_from_the_backbone():
    vertices, of, triangles = tube_mesh(arc(), RADIUS)
    ring = np.hypot(np.linalg.norm(vertices[:, :2], axis=1) - 0.05, vertices[:, 2])    # distance from the whole circle
    assert np.allclose(ring[SIDES:-SIDES], RADIUS, rtol=1e-3)
    assert np.allclose(np.linalg.norm(vertices - arc().points[of], axis=1), RADIUS)
    assert of[0] == 0 and of[-1] == 100
    assert triangles.min() == 0 and triangles.max() == len(vertices) - 1


def test_the_tube_is_seen_from_outside_and_has_no_holes():
    vertices, of, triangles = tube_mesh(arc(), RADIUS)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    outwards = (a + b + c) / 3 - arc().points[of[triangles]].mean(axis=1)
    assert (np.sum(np.cross(b - a, c - a) * outwards, axis=1) > 0).all()
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert np.count_nonzero(count == 1) == 2 * SIDES and count.max() == 2      # open at both ends only


def test_a_backbone_of_two_points_is_a_tube_too():
    assert len(tube_mesh(arc(2), RADIUS)[2]) == 2 * SIDES


def test_colours_tell_sigma():
    green, yellow, red, grey, between = sigma_colours(np.array([1e-5, 2e-4, 0.1, np.nan, 1e-4]))
    assert green[1] > 2 * green[0] and red[0] > 2 * red[1] and yellow[:2].min() > 0.8
    assert np.ptp(grey) == 0
    assert np.allclose(between, (sigma_colours(np.array([5e-5]))[0] + yellow) / 2)     # half-way in the logarithm


def xyz(v):
    return np.array([v.x, v.y, v.z])


def rgb(c):
    return np.array([c.r, c.g, c.b])


def markers(message):
    return {m.ns: m for m in message.markers}


def test_markers_of_a_shape(new):
    covariance = np.diag([1e-8, 9e-8, 4e-8])
    message = shape_to_markers(arc(covariance=covariance), RADIUS, 'ok, 78.5 mm', 5_000_000_007, 'cell', new)
    assert [m.ns for m in message.markers] == list(NAMES)
    assert {(m.action, stamp_ns(m), m.header.frame_id) for m in message.markers} == {(ADD, 5_000_000_007, 'cell')}
    m = markers(message)

    tube = m['tube']
    assert tube.type == TRIANGLES and len(tube.points) == len(tube.colors) and len(tube.points) % 3 == 0
    vertices, _, triangles = tube_mesh(arc(), RADIUS)
    assert np.allclose([xyz(p) for p in tube.points], vertices[triangles].reshape(-1, 3), atol=1e-12)
    assert np.allclose(rgb(tube.colors[0]), sigma_colours(np.array([3e-4]))[0], atol=1e-6)     # the worst direction's
    assert tube.color.a == 1 and all(c.a == 1 for c in tube.colors)
    assert (tube.pose.orientation.w, xyz(tube.scale).tolist()) == (1, [1, 1, 1])

    assert m['tip'].type == SPHERE and np.allclose(xyz(m['tip'].pose.position), [0, 0.05, 0])
    assert np.allclose(xyz(m['tip'].scale), 2 * RADIUS)

    ellipsoid = m['tip uncertainty']
    q = ellipsoid.pose.orientation
    axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    half = xyz(ellipsoid.scale) / 2
    assert ellipsoid.type == SPHERE and np.allclose(axes @ np.diag(half**2) @ axes.T, CHI2_3 * covariance, rtol=1e-3)
    assert np.allclose(xyz(ellipsoid.pose.position), [0, 0.05, 0])

    text = m['outcome']
    assert (text.type, text.text) == (TEXT, 'ok, 78.5 mm') and text.scale.z > 0 and text.color.a == 1
    assert np.allclose(xyz(text.pose.position), [-0.01, 0.05, 0], atol=1e-3)     # ahead of the tip


def test_an_unknown_covariance_is_no_ellipsoid_and_a_grey_tube(new):
    m = markers(shape_to_markers(arc(covariance=np.full((3, 3), np.nan)), RADIUS, 'ok', 1, 'cell', new))
    assert m['tip uncertainty'].action == DELETE and m['tube'].action == ADD
    assert np.ptp(rgb(m['tube'].colors[0])) == 0


def test_what_is_shown_vanishes_when_the_stream_ends(new):
    shown = [*shape_to_markers(arc(), RADIUS, 'ok', 1, 'cell', new).markers,
             *rejection_to_markers('no result', np.zeros(3), 7, 'cell', new).markers]
    assert ({(m.lifetime.sec, m.lifetime.nanosec) for m in shown if m.action == ADD} == {(LIFETIME_S, 0)}
            and 1 <= LIFETIME_S <= 5)


@pytest.mark.parametrize('place, action', [(np.array([0.1, 0.2, 0.3]), ADD), (None, DELETE)])
def test_a_rejection_takes_away_the_shape_before(new, place, action):
    message = rejection_to_markers('no result', place, 7, 'cell', new)
    m = markers(message)
    assert set(m) == set(NAMES) and {stamp_ns(x) for x in message.markers} == {7}
    assert {m[name].action for name in NAMES[:3]} == {DELETE}
    assert m['outcome'].action == action
    if place is not None:
        assert m['outcome'].text == 'no result' and np.allclose(xyz(m['outcome'].pose.position), place)
