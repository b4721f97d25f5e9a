"""Where a device goes on past an end in a bend so tight that its fit ran straight on instead: a fan of arcs."""

from __future__ import annotations

import numpy as np

from ...geometry.curve import arcs
from ...geometry.spline import Spline3
from ...imaging.strips import Sheet, cut, depth_across
from .ends import ABSENT, GOES_ON, SMOOTH_PX, SURE, evidence

STEP_PX, GROWTH_PX = 3, 30  # between places on an arc, and how far a curve is prolonged at once
BACK_PX = 0, 8, 16      # inside the end, where it may begin: a fit overshoots the bend
APART = 50.0, 12.5      # 1/m between the curvatures of a fan's arcs: of all of them, then around the best
FAN = np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if np.hypot(x, y) <= 4])


def bent_on(sheet: Sheet, spline: Spline3, reference: tuple[float, float], step: float, shadows: np.ndarray,
            usual: np.ndarray, clutter: np.ndarray, maybe: np.ndarray) -> np.ndarray | None:
    """(N, 3) m: a fitted curve between two arc lengths, going on past its ends on the arcs that both planes show best;
    None where they show none.

    step: m, a px of the finer plane. shadows: (2, w) of the device, `usual` (2,) its darkness and `clutter` (2,) that
    of places beside it in each plane. maybe: (2,) bool, the ends to look at.
    """
    both, px = np.arange(2), np.arange(STEP_PX, GROWTH_PX + max(BACK_PX), STEP_PX)
    outward, usual, clutter = np.array([-1, 1]), usual[:, None], clutter[:, None] / usual[:, None]
    least = np.sqrt(2 * ABSENT) * clutter.max()      # darkness that speaks for the device
    back, bend = np.tile(BACK_PX, (2, 1)), np.zeros((2, len(BACK_PX), 2))
    for apart in APART:
        s = np.array(reference)[:, None] - outward[:, None] * back * step                           # (2, B)
        points, tangents = (x.reshape(*s.shape, 1, 3) for x in spline.lines(s.ravel()))
        tangents *= outward[:, None, None, None] / np.linalg.norm(tangents, axis=-1, keepdims=True)
        bends = bend[:, :, None] + apart * FAN                                                      # (2, B, C, 2)
        curvature = bends @ _across(tangents[:, :, 0])                                              # (2, B, C, 3)
        places, along = arcs(points, tangents, curvature, px * step)
        dark = _darkness(sheet, places.reshape(-1, 3), along.reshape(-1, 3), shadows) / usual
        presence = dark.reshape(2, *bends.shape[:3], len(px))
        # the more of it lies in the middle of a line the better, as far as that goes
        gain = (np.cumsum(np.clip(np.nan_to_num(presence).min(axis=0), 0, 1) - least, axis=-1).max(axis=-1)
                - (1 - least) * (back / STEP_PX)[..., None])
        begin = gain.max(axis=2).argmax(axis=1)
        best = gain[both, begin].argmax(axis=1)
        back, bend = back[both, begin][:, None], bends[both, begin, best][:, None]
    inside = (SURE - ABSENT) / SMOOTH_PX * back[:, 0]       # nats, at most, of what was known before
    nats = [np.cumsum(evidence(presence[:, k, begin[k], best[k]], clutter, STEP_PX)).max() for k in both] - inside
    goes_on = maybe & (nats > GOES_ON)
    if not goes_on.any():
        return None
    start, stop = reference - outward * back[:, 0] * step * goes_on
    on = [places[k, begin[k], best[k]] if goes_on[k] else np.empty((0, 3)) for k in both]
    return np.concatenate([on[0][::-1], spline(np.linspace(start, stop, 400)), on[1]])


def _across(tangents: np.ndarray) -> np.ndarray:
    """(..., 2, 3) two unit vectors at right angles to (..., 3) unit tangents and to one another."""
    one = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=-1)])
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return np.stack([one, np.cross(tangents, one)], axis=-2)


def _darkness(sheet: Sheet, points: np.ndarray, tangents: np.ndarray, shadows: np.ndarray) -> np.ndarray:
    """(2, N) how dark a line with these shadows is in each plane, at most a px beside (N, 3) points; NaN outside its
    field."""
    strips = cut(sheet, points, tangents, shadows.shape[1] // 2 + 1, rough=True)
    near = np.abs(strips.offsets_px) <= 1
    dark = [depth_across(p, t)[:, near].max(axis=1) for p, t in zip(strips.profiles, shadows)]
    return np.where(strips.inside, dark, np.nan)
