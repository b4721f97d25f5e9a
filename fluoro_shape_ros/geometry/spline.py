"""A cubic B-spline in space on a uniform knot vector over arc length."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .curve import arc_length, at_arc_length

KNOT_SPACING = 0.008        # m: a device bends with radii of some cm
MIN_CONTROL, MAX_CONTROL = 7, 48
# row p: coefficients of u^p of the four weights
UNIFORM_CUBIC = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
DERIVATIVES = UNIFORM_CUBIC, np.diag([1.0, 2.0, 3.0], 1) @ UNIFORM_CUBIC, np.diag([2.0, 6.0], 2) @ UNIFORM_CUBIC


@dataclass(frozen=True)
class Spline3:
    """X(s) = sum_j B_j(s) C_j for s in [start, stop], about arc length in m."""

    start: float
    stop: float
    control: np.ndarray     # (n, 3) m

    def weights(self, s: np.ndarray, *derivatives: int) -> tuple[np.ndarray, ...]:
        """(N, 4) index of the control points that count at each arc length, and for each of `derivatives` (N, 4) their
        weights (de Boor 1978, uniform cubic).

        Knots are uniform, so that equal control point steps are equal speed right to the ends. Beyond them the
        outermost pieces go on.
        """
        pieces = len(self.control) - 3
        h = (self.stop - self.start) / pieces
        x = (np.asarray(s, float) - self.start) / h
        k = np.minimum(np.maximum(x, 0).astype(int), pieces - 1)
        powers = np.empty((len(x), 4))
        u = x - k
        powers[:, 0], powers[:, 1], powers[:, 2], powers[:, 3] = 1, u, u * u, u * u * u
        return k[:, None] + np.arange(4), *(powers @ (DERIVATIVES[d] / h**d) for d in derivatives)

    def bases(self, s: np.ndarray, *derivatives: int) -> list[np.ndarray]:
        """For each of `derivatives` (N, n) basis functions, or their derivatives, at (N,) arc lengths."""
        k, *weights = self.weights(s, *derivatives)
        rows, found = np.arange(len(k))[:, None], []
        for w in weights:
            found.append(np.zeros((len(k), len(self.control))))
            found[-1][rows, k] = w
        return found

    def __call__(self, s: np.ndarray, derivative: int = 0) -> np.ndarray:
        """(N, 3) points, or derivatives."""
        return self.bases(s, derivative)[0] @ self.control

    def lines(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) points and (N, 3) tangents dX/ds."""
        points, tangents = self.bases(s, 0, 1)
        return points @ self.control, tangents @ self.control


@lru_cache(MAX_CONTROL)
def bending(n: int) -> np.ndarray:
    """(n - 3, n) third differences of the control points: zero for a curve of constant curvature, as a robot's tubes
    bend."""
    return np.diff(np.eye(n), 3, axis=0)


def through(points: np.ndarray, extension: float, smoothing: float = 1e-3) -> Spline3:
    """The spline over arc length near (N, 3) points in m, going on by `extension` m at both ends; s = 0 at the first
    point."""
    length = arc_length(points)[-1]
    s = np.linspace(0, length, max(int(length / 0.0005), 50))
    points = at_arc_length(points, s)
    start, stop = -extension, length + extension
    n = int(np.clip(np.ceil((stop - start) / KNOT_SPACING) + 3, MIN_CONTROL, MAX_CONTROL))
    B = Spline3(start, stop, np.zeros((n, 3))).bases(s, 0)[0]
    D = bending(n)
    H = B.T @ B + smoothing * len(s) / n * D.T @ D
    return Spline3(start, stop, np.linalg.solve(H, B.T @ points))


def prolong(spline: Spline3, ends: tuple[bool, bool] | np.ndarray, by: float) -> tuple[Spline3, float]:
    """The spline going on straight by `by` m at the first and / or last end, and what is to be added to its old arc
    lengths."""
    s = np.linspace(spline.start, spline.stop, 400)
    points, (first, last) = spline(s), spline(s[[0, -1]], 1)
    before = points[0] - np.linspace(by, 0, 20, endpoint=False)[:, None] * first if ends[0] else points[:0]
    after = points[-1] + np.linspace(0, by, 21)[1:, None] * last if ends[1] else points[:0]
    longer = through(np.concatenate([before, points, after]), 0.0)
    return longer, -spline.start + (by if ends[0] else 0.0)
