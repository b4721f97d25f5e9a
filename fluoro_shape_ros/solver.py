"""One step of the two-image fit: the normal equations of a spline's control points, and what they know of its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .geometry import projection_jacobian
from .spline import Spline3, bending
from .strips import Measurement, Strips

BEND_SIGMA = 3e-3 / 0.01**3     # 1/m^2: typical change of curvature along a device (third differences of 3 mm at control points 10 mm apart)
SLIDE = 1e-4            # m: images do not see a curve slide along itself, so no step may
MODEL_PX = 0.15         # what the model of a strip is worth (0.03 px, the same over some 25 strips), added to the noise
BLOCK = 16              # strips over which errors that go together (anatomy, crossings) show
REDUNDANCY = 1.3        # cubic interpolation correlates neighbouring strips
REWEIGHTED = 3          # times


@dataclass(frozen=True)
class Solution:
    """A spline after one step of the solver."""

    spline: Spline3
    information: np.ndarray     # (3 n, 3 n) 1/m^2 of the control points
    offset_px: np.ndarray       # (2, N) of the device from the curve, after the step; NaN where not measured
    moved_px: float             # how far the step went, at most


@dataclass(frozen=True)
class Pieces:
    """The rows of a tall matrix (N, 3 n) sorted by the piece of the spline whose twelve unknowns each touches, as (n - 3, M) padded tables.

    Most of that matrix is zero: each strip sees four control points.
    """

    at: np.ndarray      # (n - 3, M) strip at each place of the table
    there: np.ndarray   # (n - 3, M) bool: whether there is one
    unknowns: np.ndarray    # (n - 3, 12) index of those that a piece touches

    @classmethod
    def of(cls, k: np.ndarray, n: int) -> Pieces:
        """From the (N,) ascending pieces of the strips and the number of control points."""
        starts = np.searchsorted(k, np.arange(n - 3))
        counts = np.diff(np.append(starts, len(k)))
        place = np.arange(counts.max())
        there = place < counts[:, None]
        return cls(np.where(there, starts[:, None] + place, 0), there, 3 * np.arange(n - 3)[:, None] + np.arange(12))

    def scatter(self, blocks: np.ndarray) -> np.ndarray:
        """(3 n, 3 n) sum of the (n - 3, 12, 12) overlapping blocks of the pieces."""
        size = int(self.unknowns[-1, -1]) + 1
        flat = self.unknowns[:, :, None] * size + self.unknowns[:, None, :]
        return np.bincount(flat.ravel(), blocks.ravel(), size * size).reshape(size, size)

    def gather(self, parts: np.ndarray) -> np.ndarray:
        """(3 n,) sum of the (n - 3, 12) overlapping parts."""
        return np.bincount(self.unknowns.ravel(), parts.ravel())


@dataclass(frozen=True)
class EndRow:
    """What both planes' view of one end says of the curve there: row . dC = target."""

    row: np.ndarray     # (3 n,)
    target: float       # m
    variance: float     # m^2

    @classmethod
    def of(cls, spline: Spline3, at: float, seen_at: np.ndarray, seen_sigma: np.ndarray, views) -> EndRow:
        """From where along the curve, m, each plane (2,) sees the device end.

        A curve that runs in an epipolar plane is seen across itself by neither plane; only its ends tell its depth. Moved by dX at its end, plane v
        sees that end at s_v - t_v J_v dX / |J_v X'|, t_v along the projected curve; both planes must see one end:
        (t_a J_a / |J_a X'| - t_b J_b / |J_b X'|) dX = s_a - s_b.
        """
        s = np.array([at])
        X, T = spline(s)[0], spline(s, 1)[0]
        steps = []
        for v in views:
            J = projection_jacobian(v.P, X)
            step = J @ T
            steps.append(step @ J / max(step @ step, 1e-9))
        row = (spline.basis(s)[0][:, None] * (steps[0] - steps[1])).ravel()
        return cls(row, float(seen_at[0] - seen_at[1]), float(seen_sigma @ seen_sigma))


def solve(spline: Spline3, s: np.ndarray, strips: Strips, seen: Measurement, views, within: np.ndarray, ends: Sequence[EndRow] = ()) -> Solution:
    """One Gauss-Newton step. `ends`: what else must hold.

    Residual of strip i in plane v: d_vi - n_vi . J_v(X_i) B_i dC, weighted by its variance and robustly (Tukey's biweight); prior: third
    differences of the control points. The Jacobian of a projection has rank 2, n picks what is seen across the curve.
    """
    n = len(spline.control)
    k, b = spline.weights(s)
    table = Pieces.of(k, n)
    P = np.stack([v.P for v in views])
    depth = spline(s) @ P[:, 2, :3].T + P[:, 2, 3]                                                             # (N, 2)
    along = (strips.normals * strips.centers_px).sum(axis=2)
    across = (strips.normals @ P[:, :2, :3] - along[..., None] * P[:, 2:, :3]) / depth.T[..., None]             # (2, N, 3) n . J
    rows = (b[:, :, None] * across[:, :, None, :]).reshape(2, len(s), 12)[:, table.at]                          # (2, n - 3, M, 12)
    rows = rows.transpose(1, 0, 2, 3).reshape(n - 3, -1, 12)
    tabled = lambda x: x[:, table.at].transpose(1, 0, 2).reshape(n - 3, -1)     # noqa: E731
    d = tabled(seen.offset_px)
    w0 = tabled(within / (REDUNDANCY * seen.variance + MODEL_PX**2)) * np.tile(table.there, 2)
    prior, pull = _prior(spline, s, k, b, table)
    for end in ends:
        prior, pull = prior + np.outer(end.row, end.row) / end.variance, pull + end.row * (end.target / end.variance)
    w, used = w0, w0 > 0
    for _ in range(REWEIGHTED):
        weighted = rows * w[..., None]
        step = np.linalg.solve(table.scatter(weighted.transpose(0, 2, 1) @ rows) + prior, table.gather((weighted.transpose(0, 2, 1) @ d[..., None])[..., 0]) + pull)
        moved = (rows @ step[table.unknowns][..., None])[..., 0]
        r = d - moved
        z = np.abs(r) * np.sqrt(w0)
        spread = max(1.0, 1.4826 * float(np.median(z[used]))) if used.any() else 1.0
        w = w0 * np.maximum(1 - (z / (5 * spread)) ** 2, 0) ** 2 / spread**2
    planes = np.broadcast_to(np.arange(2)[:, None], (2, table.at.shape[1])).ravel()     # of each column of the table
    together = np.array([_together((r * np.sqrt(w))[:, planes == v][used[:, planes == v]]) for v in (0, 1)])
    information = table.scatter((rows * (w / together[planes])[..., None]).transpose(0, 2, 1) @ rows) + prior
    offset = np.full((2, len(s)), np.nan)
    for v in (0, 1):
        column = planes == v
        offset[v, table.at[used[:, column]]] = r[:, column][used[:, column]]
    after = Spline3(spline.start, spline.stop, spline.control + step.reshape(n, 3))
    return Solution(after, information, offset, float(np.abs(moved[used]).max(initial=0.0)))


def _prior(spline: Spline3, s, k, b, table: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """(3 n, 3 n) and (3 n,): a device bends evenly (third differences), and no step slides it along itself."""
    n = len(spline.control)
    D = bending(n) / (BEND_SIGMA * ((spline.stop - spline.start) / (n - 3)) ** 3)
    stiffness = np.kron(D.T @ D, np.eye(3))
    slide = (b[:, :, None] * spline(s, 1)[:, None, :]).reshape(-1, 12)[table.at] * ((table.at % 4 == 0) & table.there)[..., None] / SLIDE
    return stiffness + table.scatter(slide.transpose(0, 2, 1) @ slide), -stiffness @ spline.control.ravel()


def _together(z: np.ndarray) -> float:
    """By how much the mean of BLOCK successive normalised residuals varies more than independent ones would; at least 1."""
    if len(z) < 4 * BLOCK:
        return 1.0
    blocks = z[:len(z) // BLOCK * BLOCK].reshape(-1, BLOCK)
    return max(1.0, float((blocks.mean(axis=1) ** 2).mean() * BLOCK))
