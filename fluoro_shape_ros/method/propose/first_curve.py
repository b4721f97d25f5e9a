"""From an alignment to a first curve in space: linear least squares, no point has to be triangulated alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import BSpline

from ...data import View
from ...geometry.cameras import depth, isocenter
from ...geometry.curve import arc_length
from ...geometry.spline import bending
from .alignment import Alignment

ALONG = 0.3             # correspondences along the curve count this much of what is seen across it


def first_curve(views: Sequence[View], a_px: np.ndarray, b_px: np.ndarray, alignment: Alignment) -> np.ndarray:
    """(M, 3) points in m along the device, from its two undistorted centrelines (N, 2) and (K, 2) and how they
    correspond.

    Each image point u gives the equations (P_1 - u P_3) X = 0 (HZ 12.2), turned across and along the centreline.
    """
    if alignment.flipped:
        b_px = b_px[::-1]
    along_a, along_b = alignment.along_a, alignment.along_b
    common = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(along_a), np.diff(along_b)))])
    common /= common[-1]
    n = int(np.clip(np.hypot(along_a[-1] - along_a[0], along_b[-1] - along_b[0]) / 25, 6, 30))
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, n - 2), np.ones(3)])
    center = isocenter(views)[None]
    distance = [abs(depth(v.P, center)[0]) for v in views]
    rows, right = [], []
    for view, line, along, d in zip(views, (a_px, b_px), (along_a, along_b), distance):
        s = arc_length(line)
        used = (s >= along[0]) & (s <= along[-1])
        u, s = line[used][::2], s[used][::2]
        if len(u) < 4:
            continue
        t = np.interp(s, *_increasing(along, common))
        tangent = np.gradient(u, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
        B = BSpline(knots, np.eye(n), 3)(t)
        for direction, weight in ((np.c_[-tangent[:, 1], tangent[:, 0]], 1.0), (tangent, ALONG)):
            E = (np.einsum('ik,kj->ij', direction, view.P[:2])
                 - np.einsum('ik,ik->i', direction, u)[:, None] * view.P[2]) * (weight / d)
            rows.append((B[:, :, None] * E[:, None, :3]).reshape(len(u), 3 * n))
            right.append(-E[:, 3])
    A, y = np.concatenate(rows), np.concatenate(right)
    px = np.sqrt(abs(np.linalg.det(views[0].P[:, :3]))) / distance[0]
    D = np.kron(bending(n), np.eye(3)) * px
    C = np.linalg.solve(A.T @ A + 0.3 * len(A) / n * 0.05 * D.T @ D + 1e-6 * np.eye(3 * n), A.T @ y)
    return BSpline(knots, C.reshape(n, 3), 3)(np.linspace(0, 1, 200))


def _increasing(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x without its repetitions, and the mean y at each."""
    unique, index = np.unique(x, return_inverse=True)
    return unique, np.bincount(index, y) / np.bincount(index)
