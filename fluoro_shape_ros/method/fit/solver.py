"""One step of the two-image fit: the normal equations of a spline's control points, and what they know of its
errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpbsv

from ...data import View
from ...geometry.curve import middle
from ...geometry.spline import Spline3, bending
from ...imaging.strips import Measurement, Strips

# 1/m^2: typical change of curvature along a device (third differences of 3 mm at control points 10 mm apart)
BEND_SIGMA = 3e-3 / 0.01**3
ABRUPT = 2.0            # times as much, from which on more counts in proportion only: hooks begin, leads are left
SLIDE = 1e-4            # m: images do not see a curve slide along itself, so no step may
MODEL_PX = 0.15         # what the model of a strip is worth (0.03 px, the same over some 25 strips), added to the noise
BLOCK = 16              # strips over which errors that go together (anatomy, crossings) show
REDUNDANCY = 1.3        # cubic interpolation correlates neighbouring strips
REWEIGHTED = 2          # times
BAND = 12               # unknowns that one strip sees: three of each of four control points
FLOOR = 1.0             # 1/m^2: no unknown is known less well than to a metre, so that there always is a solution


@dataclass(frozen=True)
class Layout:
    """Strips at even steps along a spline, and which unknowns each touches: what all rounds of a fit share.

    The Jacobian is tall and mostly zero: its rows are sorted by the piece of the spline whose BAND unknowns each sees,
    as (n - 3, M) padded tables, and the normal equations are banded.
    """

    s: np.ndarray           # (N,) m
    basis: np.ndarray       # (N, n) of the points,
    slope: np.ndarray       # (N, n) and of the tangents
    weights: np.ndarray     # (N, 4) of the control points that count
    at: np.ndarray          # (n - 3, M) strip at each place of the table
    there: np.ndarray       # (n - 3, M) bool: whether there is one
    unknowns: np.ndarray    # (n - 3, BAND) index of those that a piece touches
    band: np.ndarray        # (n - 3, BAND, BAND) where each term of a piece's equations stands in the lower band; past
                            # its end for those above the diagonal
    bends: np.ndarray       # (n - 3, n) 1/m: third differences of the control points, in their usual size
    prior: np.ndarray       # (BAND, 3 n) 1/m^2, lower band: no step slides the curve along itself

    @classmethod
    def of(cls, spline: Spline3, step: float) -> Layout:
        s, n = np.arange(spline.start, spline.stop, step), len(spline.control)
        k, b = spline.weights(s, 0)
        starts = np.searchsorted(k[:, 0], np.arange(n - 3))
        counts = np.diff(np.append(starts, len(k)))
        place = np.arange(counts.max())
        there = place < counts[:, None]
        local, first = np.arange(BAND), 3 * np.arange(n - 3)[:, None, None]
        below = local[:, None] - local
        band = np.where(below < 0, BAND * 3 * n, below * 3 * n + first + local)
        at, unknowns = np.where(there, starts[:, None] + place, 0), first[:, 0] + local
        bends = bending(n) / (BEND_SIGMA * ((spline.stop - spline.start) / (n - 3)) ** 3)
        basis, slope = spline.bases(s, 0, 1)
        along = ((b[:, :, None] * (slope @ spline.control)[:, None, :]).reshape(-1, BAND)[at[:, ::4]]
                 * (there[:, ::4, None] / SLIDE))
        prior = _sum(band, along.transpose(0, 2, 1) @ along, 3 * n)
        prior[0] += FLOOR
        return cls(s, basis, slope, b, at, there, unknowns, band, bends, prior)

    def stiff(self, spline: Spline3) -> tuple[np.ndarray, np.ndarray]:
        """(BAND, 3 n) the prior with what makes a device bend evenly, where it is not known to bend abruptly (weights
        of Huber 1964); and (3 n,) 1/m what that pulls at the control points with."""
        uneven = self.bends @ spline.control
        even = np.minimum(1, ABRUPT / np.maximum(np.linalg.norm(uneven, axis=1), ABRUPT))[:, None]
        stiffness, prior, n = self.bends.T @ (even * self.bends), self.prior.copy(), len(spline.control)
        for j in range(4):
            prior[3 * j, :3 * (n - j)] += np.repeat(np.diagonal(stiffness, j), 3)
        return prior, -(self.bends.T @ (even * uneven)).ravel()

    def matrix(self, blocks: np.ndarray) -> np.ndarray:
        """(BAND, 3 n) lower band of the sum of the (n - 3, BAND, BAND) overlapping blocks of the pieces."""
        return _sum(self.band, blocks, 3 * self.bends.shape[1])

    def vector(self, parts: np.ndarray) -> np.ndarray:
        """(3 n,) sum of the (n - 3, BAND) overlapping parts."""
        return np.bincount(self.unknowns.ravel(), parts.ravel())


def _sum(band: np.ndarray, blocks: np.ndarray, size: int) -> np.ndarray:
    return np.bincount(band.ravel(), blocks.ravel(), BAND * size + 1)[:-1].reshape(BAND, size)


@dataclass(frozen=True)
class Solution:
    """A spline after one step of the solver."""

    spline: Spline3
    information: Callable[[], np.ndarray]   # (BAND, 3 n) 1/m^2 of the control points, its lower band; worth computing
                                            # of the last step only
    offset_px: np.ndarray       # (2, N) of the device from the curve, after the step; NaN where not measured
    moved_px: float             # how far the step went, at most

    def covariance(self) -> np.ndarray:
        """(3 n, 3 n) m^2 of the control points."""
        return dpbsv(self.information(), np.eye(self.spline.control.size), lower=1)[1]


def solve(layout: Layout, spline: Spline3, strips: Strips, seen: Measurement, views: Sequence[View], within: np.ndarray,
          near: bool = True) -> Solution:
    """One Gauss-Newton step. near: the curve lies on the device already, so that what is far off is not it.

    Residual of strip i in plane v: d_vi - n_vi . J_v(X_i) B_i dC, weighted by its variance and robustly (Tukey's
    biweight); prior: third differences of the control points (Huber's function). The Jacobian of a projection has
    rank 2, n picks what is seen across the curve.
    """
    n, at = len(spline.control), layout.at
    P = np.stack([v.P for v in views])
    depth = layout.basis @ (spline.control @ P[:, 2, :3].T) + P[:, 2, 3]                                        # (N, 2)
    along = np.einsum('vnk,vnk->vn', strips.normals, strips.centers_px)
    # (2, N, 3) n . J
    across = (strips.normals @ P[:, :2, :3] - along[..., None] * P[:, 2:, :3]) / depth.T[..., None]
    # (2, n - 3, M, BAND)
    rows = (layout.weights[:, :, None] * across[:, :, None, :]).reshape(2, -1, BAND)[:, at]
    rows = rows.transpose(1, 0, 2, 3).reshape(n - 3, -1, BAND)
    columns = rows.transpose(0, 2, 1)
    tabled = lambda x: x[:, at].transpose(1, 0, 2).reshape(n - 3, -1)     # noqa: E731
    d = tabled(seen.offset_px)
    w0 = tabled(within / (REDUNDANCY * seen.variance + MODEL_PX**2)) * np.concatenate([layout.there] * 2, axis=1)
    prior, pull = layout.stiff(spline)
    r, root, used = d if near else np.zeros_like(d), np.sqrt(w0), w0 > 0
    for _ in range(REWEIGHTED):
        z = r * root
        spread = max(1.0, 1.4826 * float(middle(np.abs(z[used])))) if used.any() else 1.0
        w = w0 * np.maximum(1 - (z / (5 * spread)) ** 2, 0) ** 2 / spread**2
        normal = layout.matrix((columns * w[:, None]) @ rows) + prior
        step = dpbsv(normal, layout.vector((columns @ (w * d)[..., None])[..., 0]) + pull, lower=1)[1]
        moved = (rows @ step[layout.unknowns][..., None])[..., 0]
        r = d - moved
    plane = [slice(0, at.shape[1]), slice(at.shape[1], None)]      # of the table's columns
    offset = np.full((2, len(layout.s)), np.nan)
    for v, c in enumerate(plane):
        offset[v, at[used[:, c]]] = r[:, c][used[:, c]]

    def information() -> np.ndarray:
        together = np.empty_like(w)
        for c in plane:
            together[:, c] = _together((r[:, c] * np.sqrt(w[:, c]))[used[:, c]])
        return layout.matrix((columns * (w / together)[:, None]) @ rows) + prior

    after = Spline3(spline.start, spline.stop, spline.control + step.reshape(n, 3))
    return Solution(after, information, offset, float(np.abs(moved[used]).max(initial=0.0)))


def _together(z: np.ndarray) -> float:
    """By how much the mean of BLOCK successive normalised residuals varies more than independent ones would;
    at least 1."""
    if len(z) < 4 * BLOCK:
        return 1.0
    total = z[:len(z) // BLOCK * BLOCK].reshape(-1, BLOCK) @ np.ones(BLOCK)
    return max(1.0, float(total @ total) / (BLOCK * len(total)))
