"""Where a device goes on past an end in a bend so tight that its fit ran straight on instead, or beyond a pale stretch:
a fan of arcs."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from ...geometry.curve import arcs
from ...geometry.spline import Spline3
from ...imaging.strips import Sheet, cut, depths
from .ends import GOES_ON, OUTWARD, PALEST, PRESENT, SMOOTH_PX, SURE, goes_on, nats

STEP_PX = 3             # between places on an arc
BACK_PX = 0, 8, 16      # inside the end, where it may begin: a fit overshoots the bend
# a fan of arcs: their curvatures in 1/m apart, of all of them, then around the best, and the px that the device may lie
# beside one of these
FAN = np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3) if np.hypot(x, y) <= 2.3])
APART, BESIDE_PX = (80.0, 32.0, 12.0), (4, 2, 1)
ARCS = len(BACK_PX) * len(FAN) * (APART[0] / APART[-1])**2  # as near to one another as the last


def bent_on(sheet: Sheet, spline: Spline3, ends: tuple[float, float], step: float, shadows: np.ndarray,
            usual: np.ndarray, clutter: np.ndarray, open_end: np.ndarray,
            reach_px: float) -> tuple[np.ndarray, np.ndarray | None]:
    """(2,) nats by which both planes show a fitted curve going on past each of its two ends (arc lengths in m) on some
    arc; and (N, 3) m, the curve going on there, None where it does at neither.

    step: m, a px of the finer plane. shadows: (2, w) of the device; usual: (2, 2) its darkness and `clutter` (2, 2)
    that of places beside it, at each end (rows) in each plane. open_end: (2,) bool, ends at the field's border.
    reach_px: how far past them.
    """
    both, px = np.arange(2), np.arange(2 * STEP_PX, reach_px + max(BACK_PX), STEP_PX)
    clutter = np.maximum((clutter / usual).T, PALEST)[:, :, None, None, None]       # planes, ends
    back, bend = np.tile(BACK_PX, (2, 1)), np.zeros((2, len(BACK_PX), 2))
    more = ~open_end
    for apart, beside in zip(APART, BESIDE_PX):
        s = np.array(ends)[:, None] - OUTWARD[:, None] * back * step                                # (2, B)
        points, tangents = (x.reshape(*s.shape, 1, 3) for x in spline.lines(s.ravel()))
        tangents *= OUTWARD[:, None, None, None] / np.linalg.norm(tangents, axis=-1, keepdims=True)
        bends = bend[:, :, None] + apart * FAN                                                      # (2, B, C, 2)
        curvature = bends @ _across(tangents[:, :, 0])                                              # (2, B, C, 3)
        places, along = arcs(points, tangents, curvature, px * step)
        dark, speed = _darkness(sheet, places.reshape(-1, 3), along.reshape(-1, 3), shadows, beside)
        dark = np.nan_to_num(dark.reshape(2, 2, -1) / usual.T[:, :, None]).reshape(2, *bends.shape[:3], len(px), -1)
        moved = STEP_PX * np.minimum(speed * step, 1).reshape(dark.shape[:-1])      # along a ray nothing new is seen
        dark = uniform_filter1d(dark, SMOOTH_PX // STEP_PX, axis=-2, mode='nearest')
        last = apart == APART[-1]
        presence = dark.mean(axis=-1) if last else dark.max(axis=-1)
        # at most a right angle: what turns back runs along the device itself
        presence *= np.linalg.norm(bends, axis=-1)[..., None] * px * step < np.pi / 2
        seen = goes_on(presence / clutter, 1 / clutter, moved, ARCS)
        # what was known of the device before its end does not count
        known = nats((1 / clutter).min(axis=0)[..., 0, 0], 1) * back
        farther = np.where(more, np.maximum((seen.max(axis=(2, 3)) - known).max(axis=1), 0.0), 0.0)
        more = farther > GOES_ON
        if not more.any():
            return farther * last, None
        # of arcs that are seen as far, the one that lies in the middle of a line is better; half as dark is its end
        weight = clutter**-2 / (clutter**-2).sum(axis=0)
        dark = (weight * (np.clip(dark[..., beside], -1, 1) - PRESENT)).sum(axis=0)
        gain = seen * SMOOTH_PX / (2 * SURE * STEP_PX) + np.cumsum(dark, axis=-1)
        far, gain = gain.argmax(axis=-1), gain.max(axis=-1) - (back / STEP_PX)[..., None]
        begin = gain.max(axis=2).argmax(axis=1)
        best = gain[both, begin].argmax(axis=1)
        back, bend = back[both, begin][:, None], bends[both, begin, best][:, None]
    start, stop = ends - OUTWARD * back[:, 0] * step * more
    arc = both, begin, best
    on = [p[:n + 1] if on else p[:0] for p, n, on in zip(places[arc], far[arc], more)]
    return farther, np.concatenate([on[0][::-1], spline(np.linspace(start, stop, 400)), on[1]])


def _across(tangents: np.ndarray) -> np.ndarray:
    """(..., 2, 3) two unit vectors at right angles to (..., 3) unit tangents and to one another."""
    one = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=-1)])
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return np.stack([one, np.cross(tangents, one)], axis=-2)


def _darkness(sheet: Sheet, points: np.ndarray, tangents: np.ndarray, shadows: np.ndarray,
              beside_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(2, N, 2 beside_px + 1) how dark a line with these shadows is in each plane at places up to `beside_px` beside
    (N, 3) points, NaN outside its field; and (2, N) px per m of the way along unit tangents."""
    strips = cut(sheet, points, tangents, shadows.shape[1] // 2 + beside_px, rough=True)
    dark = [p @ depths(t, 2 * beside_px + 1) for p, t in zip(strips.profiles, shadows)]
    return np.where(strips.inside[..., None], dark, np.nan), strips.speed
