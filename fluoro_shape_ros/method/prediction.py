"""A kinematic model's guess of the shape: which one counts, whether it can be one at all, and whether the images bear
it out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..data import Prior, Reconstruction, View
from ..geometry.cameras import depth, project
from ..geometry.curve import arc_length, at_arc_length, even_steps
from .fit.result import Fit

STEP = 1e-3             # m, between the points that are looked at
FLOOR = 1e-3            # m, standard deviation at the base: a robot's base is known best
FAR = 3.0               # standard deviations: what is farther off is another curve
LENGTH_SHARE = 0.15     # by which the found length may differ from the predicted one,
                        # beside the tip's standard deviation
SHORTEST, LONGEST = 0.005, 2.0      # m, of a prediction
INDEPENDENT = 5         # points of a prediction whose errors have little to do with one another


@dataclass(frozen=True)
class Guess:
    """A predicted backbone, as far as it can be compared with the images."""

    points: np.ndarray      # (N, 3) m, base to tip, in equal steps of about STEP
    sigma: np.ndarray       # (N,) m, standard deviation of each, growing along the length

    @cached_property
    def tree(self) -> cKDTree:
        """What finds the nearest of the points."""
        return cKDTree(self.points)


def newest(predictions: Iterable, stamp_ns: int) -> Any:
    """Of `predictions` (anything with a stamp_ns) the newest one that is not younger than `stamp_ns`, or None."""
    return max((p for p in predictions if p.stamp_ns <= stamp_ns), key=lambda p: p.stamp_ns, default=None)


def staleness(prediction_ns: int, stamp_ns: int, max_age: float) -> str:
    """Why a prediction is too old for the pair of `stamp_ns`; empty where it is not. max_age: s."""
    if prediction_ns <= 0:
        return 'it has no stamp'
    age = (stamp_ns - prediction_ns) * 1e-9
    return f'it is {age:.2f} s older than the pair, prior_max_age is {max_age:g} s' if age > max_age else ''


def look(prior: Prior, views: Sequence[View], sigma_tip: float) -> tuple[Guess | None, str]:
    """The guess that a prior holds, or None and why it can't be one (empty: there is none). sigma_tip: m, its standard
    deviation at the tip."""
    points = prior.predicted
    if points is None or prior.prediction_fault:
        return None, prior.prediction_fault
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        return None, 'it has fewer than two points'
    if not np.isfinite(points).all():
        return None, 'its points are not finite'
    length = arc_length(points)[-1]
    if not SHORTEST < length < LONGEST:
        return None, f'its length is {1000 * length:.4g} mm'
    s = even_steps(length, STEP)
    even = at_arc_length(points, s)
    for view in views:
        if depth(view.P, even).min() <= 0 or not in_image(view, project(view.P, even)).any():
            return None, f'it lies outside plane {view.name}\'s image'
    floor = min(FLOOR, sigma_tip)
    return Guess(even, floor + (sigma_tip - floor) * s / s[-1]), ''


def judged(result: Reconstruction, g: Guess | None, why: str) -> Reconstruction:
    """`result` with what became of the prediction. why: it was ignored from the start."""
    if g is not None and result.shape is not None:
        why = doubt(result.shape.points, g)
    if why:
        return replace(result, warnings=(*result.warnings, f'prediction_ignored: {why}'), prediction=f'ignored: {why}')
    return result if g is None else replace(result, prediction='agrees' if result.shape is not None else 'not compared')


def borne_out(points: np.ndarray, g: Guess) -> bool:
    """Whether the (N, 3) curve found, of unknown direction, is the predicted one."""
    return not (doubt(points, g) and doubt(points[::-1], g))


def doubt(points: np.ndarray, g: Guess) -> str:
    """Why a guess is not borne out by the (N, 3) backbone in m that the images show, base to tip; empty where it is.

    Every point must lie near the predicted curve, and the tip near its tip, by the guess's own standard deviations.
    """
    distance, k = g.tree.query(points)
    if k[-1] < k[0]:
        return 'base and tip are the other way round'
    distance = np.append(distance, np.linalg.norm(points[-1] - g.points[-1]))
    worst = int((distance / np.append(g.sigma[k], g.sigma[-1])).argmax())
    if distance[worst] > FAR * np.append(g.sigma[k], g.sigma[-1])[worst]:
        return (f'the images show the {"tip" if worst == len(points) else "device"} {1000 * distance[worst]:.1f} '
                'mm from there')
    return ''


def informed(f: Fit, g: Guess) -> Fit:
    """The fit with what a guess that is borne out adds: a weak prior, so that it counts only where the images tell
    little.

    The product of two Gaussians (Kalman's update) on the control points: across the curve at INDEPENDENT places along
    it, since a model's errors are the same over long stretches, the guess's nearest points are observations with its
    standard deviations.
    """
    s = np.linspace(f.start, f.stop, INDEPENDENT)
    points, tangents = f.spline.lines(s)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    _, k = g.tree.query(points)
    across = np.eye(3) - tangents[:, :, None] * tangents[:, None, :]
    basis, = f.spline.bases(s, 0)
    H = (across[:, :, None, :] * basis[:, None, :, None]).reshape(3 * len(s), -1)          # (3 INDEPENDENT, 3 n)
    r = np.einsum('iab,ib->ia', across, g.points[k] - points).ravel()
    gain = f.covariance @ H.T @ np.linalg.inv(H @ f.covariance @ H.T + np.diag(np.repeat(g.sigma[k] ** 2, 3)))
    control = f.spline.control + (gain @ r).reshape(-1, 3)
    return replace(f, spline=replace(f.spline, control=control), covariance=f.covariance - gain @ H @ f.covariance)


def whole(length: float, g: Guess, views: Sequence[View]) -> bool:
    """Whether a curve of `length` m may be all of the predicted device that stands in both images."""
    inside = np.all([in_image(v, project(v.P, g.points)) for v in views], axis=0)
    predicted = STEP * np.count_nonzero(inside)
    return abs(length - predicted) < LENGTH_SHARE * predicted + g.sigma[-1]


def in_image(view: View, uv: np.ndarray) -> np.ndarray:
    """(N,) bool: which undistorted pixels (N, 2) lie in the image."""
    return ((uv > 0) & (uv < [view.width, view.height])).all(axis=1)
