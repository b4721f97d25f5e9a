"""From a fitted curve to the line beside it, which may be the device: a fit that follows a lead in one plane looks
right, but for that."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ...geometry.cameras import pixels_per_metre
from ...geometry.curve import middle
from ...imaging.strips import Measurement, Sheet, cut
from ..fit.neighbours import APART_PX, dark_along
from ..fit.result import Fit
from ..fit.solver import Layout, solve

STEP = 3                # px, between the strips
REACH_PX = 12           # how far to either side another line is looked for
OWN = 0.5               # what the darkness of the fitted line counts, so that another one, where there is one,
                        # counts more ...
MOVE_COST = 0.1         # ... and of a path that moves by a px from a strip to the next
SMOOTH = 2.0            # strips, over which the path is smoothed
OTHER_PX = 3.0          # a path nearer than that is no other line


def other_lines(sheet: Sheet, f: Fit, radius: float) -> list[np.ndarray]:
    """(M, 3) m of the curves that follow, in one plane, another line beside the fitted one wherever there is one, and
    in the other plane what the fit follows.

    radius: of the device, m.
    """
    layout = Layout.of(f.spline, STEP * (f.s[1] - f.s[0]))
    within = (layout.s >= f.start) & (layout.s <= f.stop)
    if not within.any():
        return []
    half_width_px = np.array([radius * pixels_per_metre(v.P, f.spline(layout.s[within])) for v in sheet.views])
    strips = cut(sheet, layout.basis @ f.spline.control, layout.slope @ f.spline.control,
                 np.ceil(1.6 * half_width_px.max() + 3 + REACH_PX), rough=True)
    x = strips.offsets_px
    dark = np.stack([dark_along(p, h, x) for p, h in zip(strips.profiles, half_width_px)])
    usual = [max(float(middle(d[within][:, len(x) // 2])), 1e-9) for d in dark]
    score = np.clip(dark / np.array(usual)[:, None, None], -1, 1)
    score *= np.where(np.abs(x) < half_width_px[:, None] + APART_PX, OWN, 1.0)[:, None]
    score[..., np.abs(x) > REACH_PX] = -1
    shifts = gaussian_filter1d(x[darkest_path(score, MOVE_COST)], SMOOTH, axis=1, mode='nearest')
    variance, found = np.where(within, 1.0, np.inf) * np.ones((2, 1)), []
    for plane in np.nonzero(np.abs(shifts[:, within]).max(axis=1) > OTHER_PX)[0]:
        path = Measurement(shifts * (np.arange(2) == plane)[:, None], variance, np.ones_like(shifts), np.ones(2),
                           np.ones(2), np.ones_like(shifts))
        moved = solve(layout, f.spline, strips, path, sheet.views, within, near=False).spline
        found.append(moved(np.linspace(f.start, f.stop, 200)))
    return found


def darkest_path(score: np.ndarray, move_cost: float) -> np.ndarray:
    """(V, N) column a row of the (V, N, W) scores: the path of the highest sum that moves by at most a column a row,
    each move at `move_cost` (Viterbi 1967)."""
    total = np.full((score.shape[1], len(score), score.shape[2] + 2), -np.inf)  # of paths that end there, with a margin
    total[..., 1:-1] = score.transpose(1, 0, 2)
    for before, here in zip(total[:-1], total[1:]):
        came = np.maximum(before[:, :-2], before[:, 2:]) - move_cost
        here[:, 1:-1] += np.maximum(came, before[:, 1:-1], out=came)
    left, right = total[:-1, :, :-2], total[:-1, :, 2:]
    # (N - 1, V, W) from each column of the next row
    moves = np.where(np.maximum(left, right) - move_cost > total[:-1, :, 1:-1], np.where(right > left, 1, -1), 0)
    plane, column = np.arange(len(score)), total[-1, :, 1:-1].argmax(axis=1)
    columns = [column]
    for move in moves[::-1]:
        column = column + move[plane, column]
        columns.append(column)
    return np.stack(columns[::-1], axis=1)
