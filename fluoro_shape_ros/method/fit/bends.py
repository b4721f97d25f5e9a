"""Where a device goes on past an end in a bend so tight that its fit ran straight on instead, or beyond a pale stretch:
a fan of arcs."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from ...geometry.curve import arcs
from ...geometry.spline import Spline3
from ...imaging.strips import Sheet, cut, depth_across
from .ends import ABSENT, GOES_ON, PALEST, SMOOTH_PX, SURE, nats

STEP_PX = 3             # between places on an arc
BACK_PX = 0, 8, 16      # inside the end, where it may begin: a fit overshoots the bend
APART = 50.0, 12.5      # 1/m between the curvatures of a fan's arcs: of all of them, then around the best
FAN = np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if np.hypot(x, y) <= 4])


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
    outward = np.array([-1, 1])
    clutter = np.maximum((clutter / usual).T, PALEST)[:, :, None, None, None]       # planes, ends
    back, bend = np.tile(BACK_PX, (2, 1)), np.zeros((2, len(BACK_PX), 2))
    for apart in APART:
        s = np.array(ends)[:, None] - outward[:, None] * back * step                                # (2, B)
        points, tangents = (x.reshape(*s.shape, 1, 3) for x in spline.lines(s.ravel()))
        tangents *= outward[:, None, None, None] / np.linalg.norm(tangents, axis=-1, keepdims=True)
        bends = bend[:, :, None] + apart * FAN                                                      # (2, B, C, 2)
        curvature = bends @ _across(tangents[:, :, 0])                                              # (2, B, C, 3)
        places, along = arcs(points, tangents, curvature, px * step)
        dark, speed = _darkness(sheet, places.reshape(-1, 3), along.reshape(-1, 3), shadows)
        dark = np.nan_to_num(dark.reshape(2, 2, -1) / usual.T[:, :, None]).reshape(2, *bends.shape[:3], len(px))
        moves = np.minimum(speed.min(axis=0) * step, 1).reshape(dark.shape[1:])     # along a ray nothing new is seen
        presence = uniform_filter1d(dark, SMOOTH_PX // STEP_PX, mode='nearest')
        # at most a right angle: what turns back runs along the device itself
        presence *= np.linalg.norm(bends, axis=-1)[..., None] * px * step < np.pi / 2
        z = (presence / clutter).min(axis=0)
        if apart is APART[0]:
            # what was known of the device before its end does not count, and of so many arcs the best may show noise
            known = (SURE - ABSENT) / SMOOTH_PX * back + np.log(z[0, ..., 0].size)
            farther = (np.cumsum(moves * nats(z, STEP_PX), axis=-1).max(axis=(2, 3)) - known).max(axis=1)
            farther = np.where(open_end, 0.0, np.maximum(farther, 0.0))
            goes_on = farther > GOES_ON
            if not goes_on.any():
                return farther, None
        # the more of an arc lies in the middle of a line the better; what is not seen counts as in `nats`
        seen = (z > 0) & (0.5 * z * z > ABSENT)
        gain = np.cumsum(np.where(seen, np.clip(presence.min(axis=0), 0, 1), -ABSENT / SURE), axis=-1)
        far, gain = gain.argmax(axis=-1), gain.max(axis=-1) - (back / STEP_PX)[..., None]
        begin = gain.max(axis=2).argmax(axis=1)
        best = gain[both, begin].argmax(axis=1)
        back, bend = back[both, begin][:, None], bends[both, begin, best][:, None]
    start, stop = ends - outward * back[:, 0] * step * goes_on
    arc = both, begin, best
    on = [p[:n + 1] if on else p[:0] for p, n, on in zip(places[arc], far[arc], goes_on)]
    return farther, np.concatenate([on[0][::-1], spline(np.linspace(start, stop, 400)), on[1]])


def _across(tangents: np.ndarray) -> np.ndarray:
    """(..., 2, 3) two unit vectors at right angles to (..., 3) unit tangents and to one another."""
    one = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=-1)])
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return np.stack([one, np.cross(tangents, one)], axis=-2)


def _darkness(sheet: Sheet, points: np.ndarray, tangents: np.ndarray,
              shadows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2, N) how dark a line with these shadows is in each plane, at most a px beside (N, 3) points, NaN outside its
    field; and (2, N) px per m of the way along unit tangents."""
    strips = cut(sheet, points, tangents, shadows.shape[1] // 2 + 1, rough=True)
    near = np.abs(strips.offsets_px) <= 1
    dark = [depth_across(p, t)[:, near].max(axis=1) for p, t in zip(strips.profiles, shadows)]
    return np.where(strips.inside, dark, np.nan), strips.speed
