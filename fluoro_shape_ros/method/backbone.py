"""From a fit to the published backbone: equal arc-length steps from base to tip, with the covariance of each point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Shape, View
from ..geometry.cameras import calibration_covariance
from ..geometry.curve import arc_length, even_steps, middle
from .fit.result import Fit

CALIBRATION_PX = 0.25   # what the best calibration of a plane is worth
SOME = 12               # points of a backbone at which that is worked out ...
AROUND = 12             # ... with so many strips around each, that tell whether the device lies beside the curve there


def backbone(f: Fit, views: Sequence[View], forward: bool, step: float) -> Shape:
    """The fitted spline at equal arc-length steps from base to tip, with the covariance of each point.

    Across the curve it comes from the normal equations. Along it only the ends mean anything, and there it is that of
    the end. What the calibration is worth adds to both: the images can't tell that they lie a little beside where it
    says. Where the strips around a point agree that the device lies beside the curve, as along the edge of a bone, that
    counts as much as if the calibration were off by it.
    """
    u = np.linspace(f.start, f.stop, max(int((f.stop - f.start) / 5e-4), 50))
    if not forward:
        u = u[::-1]
    along = arc_length(f.spline(u))
    s = even_steps(along[-1], step)
    at = np.interp(s, along, u)
    basis, slope = f.spline.bases(at, 0, 1)
    points, tangents = basis @ f.spline.control, slope @ f.spline.control
    n = len(f.spline.control)
    near, weights = f.spline.weights(at, 0)     # of the four control points that count at each
    between = f.covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)[near[:, :, None], near[:, None]]
    pairs = (weights[:, :, None] * weights[:, None]).reshape(len(at), 1, -1)
    covariance = ((pairs @ between.reshape(len(at), -1, 9)).reshape(-1, 3, 3)
                  + _displaced(f, views, points, tangents, at))
    tangent = tangents[[0, -1]] / np.linalg.norm(tangents[[0, -1]], axis=1, keepdims=True)
    sigma = f.end_sigma[::1 if forward else -1]
    covariance[[0, -1]] += sigma[:, None, None] ** 2 * tangent[:, :, None] * tangent[:, None, :]
    known = [np.isfinite(o) for o in f.offset_px.T]
    residuals = np.stack([np.interp(at, f.s[k], np.abs(o[k]), left=np.nan, right=np.nan)
                          if k.any() else np.full(len(at), np.nan)
                          for o, k in zip(f.offset_px.T, known)], axis=1)
    return Shape(points, s, covariance, residuals)


def _displaced(f: Fit, views: Sequence[View], points: np.ndarray, tangents: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(N, 3, 3) m^2 that planes displaced by the calibration's errors, or by what the fit leaves over, add to (N, 3)
    points at (N,) arc lengths.

    Between SOME of them it changes evenly.
    """
    k = np.linspace(0, len(points) - 1, SOME).round().astype(int)
    first = np.searchsorted(f.s, np.clip(s[k], f.start, f.stop)) - AROUND // 2
    lowest, highest = np.searchsorted(f.s, [f.start, f.stop]) + [0, -AROUND]
    first = np.clip(first, lowest, max(highest, lowest))
    around = f.offset_px[np.minimum(first[:, None] + np.arange(AROUND), len(f.s) - 1)]       # (SOME, AROUND, 2)
    left = np.abs(middle(np.where(np.isfinite(around), around, 0.0), axis=1)).max(axis=1)
    some = calibration_covariance(views, points[k], tangents[k], np.hypot(CALIBRATION_PX, left))
    at = np.interp(np.arange(len(points)), k, np.arange(SOME))
    return (np.maximum(1 - np.abs(at[:, None] - np.arange(SOME)), 0) @ some.reshape(SOME, 9)).reshape(-1, 3, 3)
