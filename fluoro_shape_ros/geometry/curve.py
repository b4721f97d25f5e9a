"""Curves in 3-D and in images: arc length, resampling, curvature."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree


def arc_length(points: np.ndarray) -> np.ndarray:
    """(N,) length along the (N, d) polyline from its first point."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def at_arc_length(points: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(M, d) points of the (N, d) polyline at the (M,) arc lengths `s`."""
    along = arc_length(points)
    return np.stack([np.interp(s, along, c) for c in points.T], axis=1)


def even_steps(length: float, step: float) -> np.ndarray:
    """0, step, 2 step, ... and exactly `length`; only the last step may be shorter."""
    s = np.arange(0.0, length, step)
    if length - s[-1] < 1e-6 * step and len(s) > 1:    # a rounding error is no step
        s = s[:-1]
    return np.append(s, length)


def resample(points: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """A cubic spline through (N, 3) points, at equal arc-length steps: (M, 3) points whose last one is the last given,
    and (M,) arc lengths."""
    points = points[np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-12)]
    spline = CubicSpline(arc_length(points), points, bc_type='natural') if len(points) > 2 else None
    if spline is not None:
        u = np.linspace(0.0, spline.x[-1], max(20 * len(points), int(8 * spline.x[-1] / step) + 2))
        points = spline(u)
    s = even_steps(arc_length(points)[-1], step)
    return at_arc_length(points, s), s


def curvature(points: np.ndarray) -> np.ndarray:
    """(N - 2,) curvature, 1/m, of the circle through each three successive points of (N, 3) (Menger)."""
    a, b = np.diff(points, axis=0)[:-1], np.diff(points, axis=0)[1:]
    c = points[2:] - points[:-2]
    sides = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(c, axis=1)
    return 2 * np.linalg.norm(np.cross(a, b), axis=1) / np.maximum(sides, 1e-30)


def frames(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) tangents and (N, 3) normals, unit vectors, at (N, 3) points; the normals turn with the curve and not about
    it."""
    tangents = np.gradient(points, arc_length(points), axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.empty_like(tangents)
    normal = np.eye(3)[np.abs(tangents[0]).argmin()]
    for k, t in enumerate(tangents):    # carried from point to point: a frame is defined by its past
        normal = normal - (normal @ t) * t
        normals[k] = normal = normal / np.linalg.norm(normal)
    return tangents, normals


def arcs(points: np.ndarray, tangents: np.ndarray, curvature: np.ndarray,
         s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(..., M, 3) points and unit tangents at (M,) m along circular arcs from (..., 3) points.

    tangents: (..., 3) unit, of the arcs there. curvature: (..., 3) 1/m, across these, to where the arcs bend.
    """
    k, (p, t, c), s = np.linalg.norm(curvature, axis=-1)[..., None, None], (x[..., None, :] for x in
                                                                            (points, tangents, curvature)), s[:, None]
    along, half = s * np.sinc(k * s / np.pi), np.sinc(k * s / (2 * np.pi))      # sin(ks) / k
    return p + t * along + 0.5 * c * (s * half)**2, t * np.cos(k * s) + c * along


def middle(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """The median along an axis, of an even number the upper one of the middle two; several times as fast as NumPy's."""
    k = values.shape[axis] // 2
    parted = values.copy()
    parted.partition(k, axis=axis)
    return parted.take(k, axis=axis)


def distance_to(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """(N,) distance of (N, d) points to the nearer of the two segments of the (M, d) polyline that meet at its nearest
    vertex."""
    near = np.clip(cKDTree(line).query(points)[1][:, None] + [-1, 0], 0, len(line) - 2)
    segment, rel = line[near + 1] - line[near], points[:, None] - line[near]
    t = np.clip((rel * segment).sum(-1) / np.maximum((segment * segment).sum(-1), 1e-30), 0, 1)
    return np.linalg.norm(rel - t[..., None] * segment, axis=-1).min(axis=1)
