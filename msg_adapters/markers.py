"""The backbone for the eye: a visualization_msgs/MarkerArray for RViz and Foxglove.

Everything is in the reference frame, in metres; `new` is a factory (see messages). Every array sets or deletes all of
NAMES, so that nothing of an earlier pair stays in view, and what it sets vanishes by itself after LIFETIME_S, so that
nothing stays when the stream ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from fluoro_shape_ros.data import Shape

from .messages import New, header
from .shapes import _worst_sigma, orientations, tangents

NAMES = ('tube', 'tip', 'tip uncertainty', 'outcome')   # namespaces, one marker each
CONFIDENCE = 0.95       # of the tip's ellipsoid
LIFETIME_S = 3
RINGS, SIDES = 40, 8    # of the tube's mesh, at most
TEXT_HEIGHT = 0.004     # m
TEXT_GAP = 0.01         # m, beyond the tip
_ADD, _DELETE = 0, 2                                            # visualization_msgs/Marker
_SPHERE, _TEXT, _TRIANGLES = 2, 9, 11
_TIP, _ELLIPSOID, _WORDS = (1.0, 0.35, 0.37, 0.7), (1.0, 0.9, 0.3, 0.5), (1.0, 1.0, 1.0, 1.0)    # r, g, b, a
_UNKNOWN = (0.6, 0.6, 0.6)
_SCALE = np.log([5e-5, 2e-4, 1e-3])                             # sigma in m that is green, yellow, red
_COLOURS = np.array([[0.25, 0.85, 0.35], [0.95, 0.85, 0.2], [0.95, 0.2, 0.2]])


def shape_to_markers(shape: Shape, robot_radius: float, text: str, stamp_ns: int, frame_id: str, new: New) -> Any:
    """MarkerArray of a shape: a tube of `robot_radius` (m) coloured by sigma, the tip, the ellipsoid that holds it with
    CONFIDENCE, and a text beside it.

    Green is a sigma (in the worst direction) of 0.05 mm and less, yellow 0.2 mm, red 1 mm and more, grey unknown. The
    ellipsoid is left out where the covariance is not known.
    """
    tip = shape.tip
    ball = dict(type=_SPHERE, pose=_pose(tip, (0.0, 0.0, 0.0, 1.0), new), scale=_vector([2 * robot_radius] * 3, new),
                color=_colour(_TIP, new))
    label = _words(text, tip + TEXT_GAP * tangents(shape)[-1], new)
    return _array([_tube(shape, robot_radius, new), ball, _ellipsoid(tip, shape.covariance[-1], new), label], stamp_ns,
                  frame_id, new)


def rejection_to_markers(text: str, place: np.ndarray | None, stamp_ns: int, frame_id: str, new: New) -> Any:
    """MarkerArray that removes the shape shown before and writes why there is none at `place`, (3,) m, or nowhere where
    that is None."""
    return _array([None, None, None, None if place is None else _words(text, place, new)], stamp_ns, frame_id, new)


def _array(markers: list[dict | None], stamp_ns: int, frame_id: str, new: New) -> Any:
    head, lifetime = header(new, stamp_ns, frame_id), new('builtin_interfaces/msg/Duration', sec=LIFETIME_S)
    return new('visualization_msgs/msg/MarkerArray', markers=[
        new('visualization_msgs/msg/Marker', header=head, ns=name, action=_DELETE if fields is None else _ADD,
            lifetime=lifetime, **(fields or {}))
        for name, fields in zip(NAMES, markers, strict=True)])


def tube_mesh(shape: Shape, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) in m, the backbone point (V,) of each, and triangles (T, 3) as their indices, anticlockwise seen
    from outside.

    An open tube: SIDES vertices a ring, at most RINGS rings.
    """
    n = len(shape.points)
    at = np.unique(np.linspace(0, n - 1, min(n, RINGS)).round().astype(int))
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    across = Rotation.from_quat(orientations(shape)[at]).as_matrix()[:, :, 1:]     # of each frame, y and z
    vertices = shape.points[at, None] + radius * np.einsum('rij,kj->rki', across, np.c_[np.cos(angle), np.sin(angle)])
    corner = np.arange(len(at) * SIDES).reshape(-1, SIDES)
    turned = np.roll(corner, -1, axis=1)
    a, b, c, d = (x.ravel() for x in (corner[:-1], turned[:-1], turned[1:], corner[1:]))
    return vertices.reshape(-1, 3), np.repeat(at, SIDES), np.stack([a, b, d, b, c, d], axis=1).reshape(-1, 3)


def sigma_colours(sigma: np.ndarray) -> np.ndarray:
    """(N, 3) red, green, blue in [0, 1] of (N,) standard deviations in m."""
    at = np.log(np.maximum(sigma, 1e-12))
    colours = np.stack([np.interp(at, _SCALE, c) for c in _COLOURS.T], axis=1)
    return np.where(np.isfinite(sigma)[:, None], colours, _UNKNOWN)


def _tube(shape: Shape, radius: float, new: New) -> dict:
    vertices, of, triangles = tube_mesh(shape, radius)
    # few messages that many triangles share: making one costs more than all else
    points = [_point(p, new) for p in vertices.tolist()]
    colours = [_colour((*c, 1.0), new) for c in sigma_colours(_worst_sigma(shape.covariance)).tolist()]
    corners = triangles.ravel()
    return dict(type=_TRIANGLES, pose=_pose(np.zeros(3), (0.0, 0.0, 0.0, 1.0), new), scale=_vector([1.0] * 3, new),
                color=_colour(_WORDS, new),
                points=[points[k] for k in corners.tolist()], colors=[colours[k] for k in of[corners].tolist()])


def _ellipsoid(center: np.ndarray, covariance: np.ndarray, new: New) -> dict | None:
    if not np.isfinite(covariance).all():
        return None
    variance, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.linalg.det(axes)   # a rotation, no mirror
    diameters = 2 * np.sqrt(np.maximum(variance * chdtri(3, 1 - CONFIDENCE), 1e-12))
    return dict(type=_SPHERE, pose=_pose(center, Rotation.from_matrix(axes).as_quat().tolist(), new),
                scale=_vector(diameters.tolist(), new), color=_colour(_ELLIPSOID, new))


def _words(text: str, place: np.ndarray, new: New) -> dict:
    return dict(type=_TEXT, text=text, pose=_pose(place, (0.0, 0.0, 0.0, 1.0), new),
                scale=_vector([0.0, 0.0, TEXT_HEIGHT], new), color=_colour(_WORDS, new))


def _point(p: Sequence[float], new: New) -> Any:
    return new('geometry_msgs/msg/Point', x=p[0], y=p[1], z=p[2])


def _pose(p: np.ndarray, q: Sequence[float], new: New) -> Any:
    return new('geometry_msgs/msg/Pose', position=_point(p.tolist(), new),
               orientation=new('geometry_msgs/msg/Quaternion', x=q[0], y=q[1], z=q[2], w=q[3]))


def _vector(v: Sequence[float], new: New) -> Any:
    return new('geometry_msgs/msg/Vector3', x=v[0], y=v[1], z=v[2])


def _colour(c: Sequence[float], new: New) -> Any:
    return new('std_msgs/msg/ColorRGBA', r=c[0], g=c[1], b=c[2], a=c[3])
