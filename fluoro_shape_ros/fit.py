"""The 3-D spline fitted to both images at once.

Project the curve, cut strips across it in both images, see how far the device lies off in each, solve for the control points, repeat. Residuals
are perpendicular and sub-pixel, no correspondence is needed any more, and the normal equations carry the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .curve import arc_length
from .extent import bulge, locate, supported
from .geometry import pixels_per_metre, projection_jacobian
from .spline import Spline3, bending, prolong, through
from .strips import Measurement, Strips, cut, half_width_range, likeness, mean_profile, measure, own_shadow, search, shadow

COARSE, FINE = 2, 3
COARSE_STEP = 3         # px between the strips of a coarse round
SETTLED_PX = 0.1        # a fine round that moves the curve less is the last
WIDE_PX = 8.0           # extra reach of the strips while the start is still rough
EXTENSION_PX = 26.0     # how far beyond the presumed ends is looked
NEAR_END_PX = 8
GROWTH, GROWTH_PX = 8, 30   # how often the curve may be prolonged, and by how much
ASIDE = 0.8             # darkness beside the extension of a fit, as a share of the device's, that makes a tracked fit suspect
GOES_ON = 0.25          # darkness beyond an end, as a share of the usual, that makes one look farther
BEND_SIGMA = 3e-3 / 0.01**3     # 1/m^2: typical change of curvature along a device (third differences of 3 mm at control points 10 mm apart)
SLIDE = 1e-4             # m: images do not see a curve slide along itself, so no step may
MODEL_PX = 0.15         # what the model of a strip is worth (0.03 px, the same over some 25 strips), added to the noise
BLOCK = 16              # strips over which errors that go together (anatomy, crossings) show
REDUNDANCY = 1.3        # cubic interpolation correlates neighbouring strips


@dataclass(frozen=True)
class Fit:
    """A curve that lies on the device in both images."""

    spline: Spline3
    start: float                # m, arc length where the device begins ...
    stop: float                 # ... and where it ends
    end_sigma: np.ndarray       # (2,) m, of those two along the curve
    open_end: np.ndarray        # (2,) bool: the device leaves the field there
    covariance: np.ndarray      # (3 n, 3 n) m^2 of the control points
    s: np.ndarray               # (N,) m
    presence: np.ndarray        # (N, 2)
    offset_px: np.ndarray       # (N, 2) of the device from the fitted curve; NaN where not measured
    contrast: np.ndarray        # (2,) share of the beam that the device takes at its middle, after blur
    across: np.ndarray          # (2,) the same as if seen straight on, by Beer-Lambert
    likeness: np.ndarray        # (2,) correlation of its profile with that of a cylinder of robot_radius
    beyond: np.ndarray          # (2, 2) darkness just past the first and the last end (rows) in plane A, B, as a share of the device's


def fit(images, fields, views, points: np.ndarray, radius: float, coarse: int = COARSE) -> Fit | None:
    """A Fit that starts at (N, 3) points in m, known to a few px; None where the images show no device there.

    images, fields: (H, W) float32 (dark device) and uint8, a pair each. radius: of the device, m. coarse: rounds that search for it a few px around.
    """
    scale = [pixels_per_metre(v.P, points) for v in views]
    half_width = [radius * k for k in scale]
    step = 1 / max(scale)
    spline = through(points, EXTENSION_PX * step)
    reference = (0.0, arc_length(points)[-1])
    grown, length_px = 0, 0.0
    rounds = [True] * coarse + [False] * FINE
    while rounds:
        wide = rounds.pop(0)
        s = np.arange(spline.start, spline.stop, COARSE_STEP * step if wide else step)
        strips = _cut_both(images, fields, views, spline, s, half_width, WIDE_PX if wide else 0.0)
        within = (s >= reference[0]) & (s <= reference[1])
        if wide:
            seen = [search(t, shadow(h, np.arange(-half_width_range(h), half_width_range(h) + 1)), smooth=3) for t, h in zip(strips, half_width)]
            spline = solve(spline, s, strips, seen, views, within).spline
            continue
        expected = [shadow(h, t.offsets_px) for t, h in zip(strips, half_width)]
        profiles = [own_shadow(t, within & t.inside, e) for t, e in zip(strips, expected)]
        seen = [measure(t, p, within) for t, p in zip(strips, profiles)]
        solution = solve(spline, s, strips, seen, views, within)
        spline = solution.spline
        presence = np.stack([m.presence for m in seen], axis=1)
        stretch = supported(presence)
        if stretch is None:
            return None
        settled = solution.moved_px < SETTLED_PX and np.abs(np.subtract(reference, (s[stretch[0]], s[stretch[1]]))).max() < 2 * step
        reference = (s[stretch[0]], s[stretch[1]])
        if (rounds and not settled) or grown == GROWTH:
            continue
        beyond = np.stack([_beyond(presence, stretch[0], -1), _beyond(presence, stretch[1], 1)])
        goes_on = [bool((b > GOES_ON).all()) for b in beyond]
        gained = (reference[1] - reference[0]) / step - length_px
        if any(goes_on) and (not grown or gained > NEAR_END_PX):        # look farther, as long as that finds something
            length_px = (reference[1] - reference[0]) / step
            spline, shift = prolong(spline, goes_on, GROWTH_PX * step)
            reference = (reference[0] + shift - goes_on[0] * GROWTH_PX * step, reference[1] + shift + goes_on[1] * GROWTH_PX * step)
            rounds, grown = [True] + [False] * (FINE - 1), grown + 1
    return _finish(solution, s, strips, seen, presence, reference, beyond, half_width, radius)


@dataclass(frozen=True)
class Solution:
    """A spline after one step of the solver."""

    spline: Spline3
    information: np.ndarray     # (3 n, 3 n) 1/m^2 of the control points
    offset_px: np.ndarray       # (N, 2) of the device from the curve, after the step; NaN where not measured
    moved_px: float             # how far the step went, at most


@dataclass(frozen=True)
class Local:
    """A tall matrix (N, 3 n) whose row i touches the twelve unknowns from 3 k[i] on: only those are kept. k ascends."""

    k: np.ndarray       # (N,)
    rows: np.ndarray    # (N, 12)
    n: int              # control points

    def normal(self, w: np.ndarray) -> np.ndarray:
        """(3 n, 3 n) A^T diag(w) A: a product a piece of the spline, each padded to the same number of rows, all at once."""
        starts = np.searchsorted(self.k, np.arange(self.n - 3))
        counts = np.diff(np.append(starts, len(self.k)))
        at = starts[:, None] + np.arange(counts.max())
        there = np.arange(counts.max()) < counts[:, None]
        at = np.where(there, at, 0)
        rows = self.rows[at]
        blocks = rows.transpose(0, 2, 1) @ (rows * np.where(there, w[at], 0)[:, :, None])
        H = np.zeros((3 * self.n, 3 * self.n))
        for piece, block in enumerate(blocks):      # some 20 pieces, each overlaps the next in three control points
            H[3 * piece:3 * piece + 12, 3 * piece:3 * piece + 12] += block
        return H

    def transposed(self, y: np.ndarray) -> np.ndarray:
        """(3 n,) A^T y."""
        return np.bincount((3 * self.k[:, None] + np.arange(12)).ravel(), (self.rows * y[:, None]).ravel(), 3 * self.n)

    def __matmul__(self, x: np.ndarray) -> np.ndarray:
        """(N,) A x."""
        return np.einsum('ij,ij->i', self.rows, x[3 * self.k[:, None] + np.arange(12)])


def solve(spline: Spline3, s: np.ndarray, strips: list[Strips], seen: list[Measurement], views, within: np.ndarray) -> Solution:
    """One Gauss-Newton step.

    Residual of strip i in plane v: d_vi - n_vi . J_v(X_i) B_i dC, weighted by its variance and robustly (Tukey's biweight); prior: third
    differences of the control points. The Jacobian of a projection has rank 2, n picks what is seen across the curve.
    """
    n = len(spline.control)
    k, b = spline.weights(s)
    X = spline(s)
    J = np.stack([np.einsum('ij,ijk->ik', t.normals, projection_jacobian(v.P, X)) for t, v in zip(strips, views)], axis=1)     # (N, 2, 3)
    A = (b[:, None, :, None] * J[:, :, None, :]).reshape(-1, 12)            # each row touches four control points; rows stay sorted by k
    rows = Local(np.repeat(k, 2), A, n)
    d = np.stack([m.offset_px for m in seen], axis=1).ravel()
    w0 = np.stack([1 / (REDUNDANCY * m.variance + MODEL_PX**2) for m in seen], axis=1) * within[:, None]
    w0 = w0.ravel()
    D = np.kron(bending(n), np.eye(3)) / (BEND_SIGMA * ((spline.stop - spline.start) / (n - 3)) ** 3)
    slide = Local(k[::4], (b[::4, :, None] * spline(s[::4], 1)[:, None, :]).reshape(-1, 12) / SLIDE, n)
    prior = D.T @ D + slide.normal(np.ones(len(slide.k)))
    g0 = -D.T @ (D @ spline.control.ravel())
    w, used = w0, w0 > 0
    for _ in range(3):
        step = np.linalg.solve(rows.normal(w) + prior, rows.transposed(w * d) + g0)
        r = d - rows @ step
        z = np.abs(r) * np.sqrt(w0)
        spread = max(1.0, 1.4826 * float(np.median(z[used]))) if used.any() else 1.0
        w = w0 * np.maximum(1 - (z / (5 * spread)) ** 2, 0) ** 2 / spread**2
    together = np.array([_together((r * np.sqrt(w))[v::2], used[v::2]) for v in (0, 1)])
    information = rows.normal((w.reshape(-1, 2) / together).ravel()) + prior
    moved = Spline3(spline.start, spline.stop, spline.control + step.reshape(n, 3))
    return Solution(moved, information, np.where(used, r, np.nan).reshape(-1, 2), float(np.abs(rows @ step)[used].max(initial=0.0)))


def _together(z: np.ndarray, used: np.ndarray) -> float:
    """By how much the mean of BLOCK successive normalised residuals varies more than independent ones would; at least 1."""
    z = z[used]
    if len(z) < 4 * BLOCK:
        return 1.0
    blocks = z[:len(z) // BLOCK * BLOCK].reshape(-1, BLOCK)
    return max(1.0, float((blocks.mean(axis=1) ** 2).mean() * BLOCK))


def _cut_both(images, fields, views, spline: Spline3, s: np.ndarray, half_width, extra: float) -> list[Strips]:
    X, T = spline(s), spline(s, 1)
    return [cut(image, field, v, X, T, half_width_range(h) + extra) for image, field, v, h in zip(images, fields, views, half_width)]


def _beyond(presence: np.ndarray, at: int, outward: int) -> np.ndarray:
    """(2,) darkness that each plane shows just past strip `at`, as a share of the device's; NaN outside its field, 1 where the strips end before it does."""
    past = presence[at + 5:at + 22] if outward > 0 else presence[max(at - 21, 0):max(at - 4, 0)]
    if len(past) < 10:
        return np.where(np.isnan(past).any(axis=0), np.nan, 1.0)
    return np.median(past, axis=0)


def _finish(solution: Solution, s, strips, seen, presence, reference, beyond, half_width, radius) -> Fit:
    speed = np.stack([t.speed for t in strips], axis=1)
    inside = np.stack([t.inside for t in strips], axis=1)
    lit = np.stack([t.lit for t in strips], axis=1).all(axis=1)
    sigma = np.array([m.presence_sigma for m in seen])
    between = (s > reference[0]) & (s < reference[1])
    profile = [mean_profile(t, between) for t in strips]
    contrast = np.array([_contrast(p) for p in profile])
    scale = np.array(half_width) / radius
    across = 1 - (1 - contrast) ** np.clip(np.median(speed[between], axis=0) / scale, 0.2, 1)     # Beer-Lambert: seen straight on
    alike = np.array([likeness(p, h) for p, h in zip(profile, half_width)])
    ends, end_sigma, open_end = list(reference), np.zeros(2), np.zeros(2, bool)
    for k, outward in enumerate((-1, 1)):
        i = min(int(np.searchsorted(s, reference[k])), len(s) - 1)
        past = inside[i:i + 14] if outward > 0 else inside[max(i - 14, 0):i + 1]
        if not past.all():    # it runs out of a field before its end could be seen
            open_end[k] = True
            dark = np.nonzero(~lit[i:] if outward > 0 else ~lit[:i + 1][::-1])[0]
            ends[k] = s[min(max(i + outward * (dark[0] - 1 if len(dark) else 0), 0), len(s) - 1)]
            continue
        ends[k], end_sigma[k] = locate(s, presence, sigma, speed, reference[k], outward, bulge(radius, speed[i], scale, across),
                                       radius / float(np.tan(np.arcsin(np.clip(speed[i] / scale, 0.1, 1.0))).min()))
    covariance = np.linalg.inv(solution.information)
    return Fit(solution.spline, ends[0], ends[1], end_sigma, open_end, covariance, s, presence, solution.offset_px, contrast, across, alike, np.nan_to_num(beyond))


def _contrast(profile: np.ndarray) -> float:
    """Share of the counts that the device takes at its middle; profiles are square roots of counts."""
    return 1 - (profile[len(profile) // 2] / max(float(np.mean(profile[[0, 1, -2, -1]])), 1e-9)) ** 2


def shown(f: Fit) -> np.ndarray:
    """(2,) share of the device's length that each plane shows."""
    between = (f.s > f.start) & (f.s < f.stop)
    return (np.nan_to_num(f.presence[between]) > 0.4).mean(axis=0) if between.any() else np.zeros(2)


def contrast_ratio(f: Fit) -> float:
    """How many times as dark one plane shows the device as the other, at least 1: as seen for an opaque device, as if straight on for a translucent one."""
    return float(min(c.max() / max(c.min(), 1e-6) for c in (f.contrast, f.across)))


def continues(images, fields, views, f: Fit, radius: float) -> bool:
    """Whether the device goes on beside the fit's ends, where the curve may have lost it: a line as dark as the device within WIDE_PX, in either plane."""
    step = f.s[1] - f.s[0]
    half_width = [radius * pixels_per_metre(v.P, f.spline(np.array([f.start, f.stop]))) for v in views]
    for k, (end, outward) in enumerate(((f.start, -1), (f.stop, 1))):
        if f.open_end[k]:
            continue
        px = np.arange(-80, 20)
        strips = _cut_both(images, fields, views, f.spline, end + outward * px * step, half_width, WIDE_PX)
        for t, h in zip(strips, half_width):
            line = search(t, shadow(h, np.arange(-half_width_range(h), half_width_range(h) + 1)))
            if np.median(line.presence[(px > 6) & (px < 18)]) > ASIDE:
                return True
    return False
