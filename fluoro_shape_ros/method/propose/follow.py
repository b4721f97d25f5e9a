"""From a predicted curve to the device near it: in strips across its projections, the darkest smooth path, and one step
of the fit's solver to both.

The path in each plane is the most probable one (Viterbi 1967) where the response of each strip speaks for a shift and
the prediction's standard deviation against it. Shifts in the two planes are the two directions across the curve, so
each plane can be asked alone.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from ...data import View
from ...geometry.cameras import pixels_per_metre
from ...geometry.curve import arc_length, middle
from ...geometry.spline import through
from ...imaging.profiles import shadow
from ...imaging.strips import Measurement, Sheet, Strips, lay_out
from ..fit.solver import Layout, solve
from ..prediction import Guess, in_image
from .other_lines import darkest_path

STEP_PX = 6.0           # between strips ...
SHIFT_PX = 3            # ... and between shifts, so that a path may turn by 27 degrees from the prediction
WITHIN = 2.0            # standard deviations to either side that a strip reaches
BEYOND_PX = 30.0        # the path goes on straight past both ends: the device may be longer
STRONGEST = 6.0         # noise deviations: a darker strip speaks no louder, it may be something else
BEND_COST = 0.7         # of a shift that changes from a strip to the next ...
TRUST = 0.15            # ... and what the prediction counts in each strip: its error is the same in many
SMOOTH = 1.5            # strips, over which the path is smoothed
CLEAR = 2.0             # noise deviations: darker strips speak for the device, others against it
SHORTEST = 0.6          # share of the strips ...
SEEN = 0.93             # ... and how many of these must be clear, for a path that is worth a try


def reach_px(guess: Guess, view: View) -> float:
    """How far from the projected guess the image is looked at."""
    return WITHIN * float(guess.sigma.max()) * pixels_per_metre(view.P, guess.points) + BEYOND_PX + 50


def follow(sheet: Sheet, guess: Guess, radius: float, clear: bool = True) -> np.ndarray | None:
    """(M, 3) points in m along what looks most like the device of `radius` m near `guess`, base to tip; None where
    nothing does.

    clear: only where it is seen nearly all the way.
    """
    views = sheet.views
    scale = np.array([pixels_per_metre(v.P, guess.points) for v in views])
    spline = through(guess.points, BEYOND_PX / scale.max())
    layout = Layout.of(spline, STEP_PX / scale.max())
    sigma_px = (np.interp(layout.s, np.linspace(0, arc_length(guess.points)[-1], len(guess.sigma)), guess.sigma)
                * scale[:, None])     # (2, N)
    reach = SHIFT_PX * int(np.ceil(WITHIN * sigma_px.max() / SHIFT_PX))
    shifts = np.arange(-reach, reach + 1)
    centers, normals, speed = lay_out(views, layout.basis @ spline.control, layout.slope @ spline.control)
    strength = _response(sheet, sheet.places(centers, normals, shifts), radius * scale)[..., ::SHIFT_PX]
    shifts = shifts[::SHIFT_PX]
    away = shifts / sigma_px[..., None]
    best = darkest_path(np.where(np.abs(away) > WITHIN, -np.inf, strength - TRUST * away**2 / 2), BEND_COST)
    gain = np.take_along_axis(strength, best[..., None], axis=2)[..., 0] - CLEAR
    seen = np.zeros(gain.shape, bool)
    for g, s, c, v in zip(gain, seen, centers, views):
        start, stop = _darkest_stretch(g)
        if stop - start < 2 or clear and (stop - start < SHORTEST * in_image(v, c).sum()
                                          or (g[start:stop] > 0).mean() < SEEN):
            return None
        s[start:stop] = True
    both = np.nonzero(seen.all(axis=0))[0]
    if len(both) < 2 or clear and len(both) < SHORTEST * seen.sum(axis=1).max():
        return None
    shift = gaussian_filter1d(shifts[best].astype(float), SMOOTH, axis=1, mode='nearest')
    path = Measurement(shift, np.where(seen, 1.0, np.inf), gain, np.ones(2), np.ones(2), np.ones_like(shift))
    strips = Strips(centers, normals, speed, strength, shifts, seen, seen)
    moved = solve(layout, spline, strips, path, views, np.ones(len(layout.s), bool), near=False).spline
    return moved(np.linspace(layout.s[both[0]], layout.s[both[-1]], 200))


def _response(sheet: Sheet, at: tuple[np.ndarray, np.ndarray], half_width_px: np.ndarray) -> np.ndarray:
    """(V, N, W) how much darker than beside it each place at (V, N, W) columns and rows is, over the device's width, in
    noise deviations; 0 outside the field."""
    profiles, lit = sheet.sample(*at, cv2.INTER_LINEAR), sheet.exposed(*at)
    half = int(np.ceil(1.6 * half_width_px.max() + 3))
    templates = [shadow(h, np.arange(-half, half + 1)) for h in half_width_px]
    response = np.stack([cv2.filter2D(p, cv2.CV_32F, (t.mean() - t)[None].astype(np.float32),
                                      borderType=cv2.BORDER_REPLICATE) for p, t in zip(profiles, templates)])
    if not lit.all():
        flat = lit.astype(np.uint8).reshape(-1, lit.shape[2])
        lit = cv2.erode(flat, np.ones((1, 2 * half + 1), np.uint8), borderValue=255).reshape(lit.shape) > 0
    noise = [1.4826 * float(middle(np.abs(r[i][::3]))) + 1e-6 if i.any() else 1.0 for r, i in zip(response, lit)]
    return np.where(lit, np.clip(response / np.array(noise, np.float32)[:, None, None], -1.0, STRONGEST), 0.0)


def _darkest_stretch(gain: np.ndarray) -> tuple[int, int]:
    """First and past-the-last index of the successive (N,) numbers with the largest sum (Kadane 1984)."""
    total = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(total)
    stop = int((total - lowest).argmax())
    return int(total[:stop + 1].argmin()), stop
