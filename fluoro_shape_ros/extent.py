"""Where along the curve the device is, and exactly where it ends: an edge along the axis, solved in both planes at once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

PRESENT = 0.5           # of the usual darkness
HIDDEN = 0.15           # a plane that shows even less than this may be hidden there
BRIDGED_PX = 70         # a stretch that only one plane shows, or none up to GAP_PX, does not end the device
GAP_PX = 30
SMOOTH_PX = 9
REACH_PX = 12.0         # the edge is looked for this far around the first guess
COARSE_PX, FINE_PX = 0.8, 0.2  # steps of the search
BLURS_PX = (0.8, 1.2, 1.9)
OPAQUE = (0.3, 0.55)    # measured contrast at which a device counts as translucent, and as opaque
RAMP = 0.1
DISAGREE_PX = 0.9       # what the planes' ends may differ by, beside noise
FLOOR_PX = 0.12         # what the model of the edge itself is worth


def supported(presence: np.ndarray) -> tuple[int, int] | None:
    """First and last index of the device's stretch of (N, 2) presence (NaN: outside the field), steps of about a pixel; None where there is none."""
    smooth = cv2.blur(np.nan_to_num(np.clip(presence, -1, 2)).astype(np.float32), (1, SMOOTH_PX), borderType=cv2.BORDER_REPLICATE)
    both, either = (smooth > PRESENT).all(axis=1), (smooth > PRESENT).any(axis=1)
    at = np.nonzero(both)[0]
    if len(at) < 5:
        return None
    gaps = np.nonzero(np.diff(at) > 1)[0]
    # a gap is bridged when it is short, or when one plane shows the device nearly all the way
    cut = [g for g in gaps if at[g + 1] - at[g] > GAP_PX and not (at[g + 1] - at[g] <= BRIDGED_PX and either[at[g]:at[g + 1]].mean() > 0.8)]
    starts, stops = np.r_[0, np.array(cut, int) + 1], np.r_[np.array(cut, int), len(at) - 1]
    best = np.argmax([both[at[i]:at[j] + 1].sum() for i, j in zip(starts, stops)])
    return int(at[starts[best]]), int(at[stops[best]])


def bulge(radius: float, speed: np.ndarray, px_per_m: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """(2,) m by which the shadow of a flat end reaches beyond the axis' end in each plane, seen at an angle.

    The end's rim is an ellipse. An opaque device shows all of it: r cos / sin of the angle between ray and axis, times 0.69 for a step fitted to it (0.785 on average
    over the width, most of it near the middle).
    A translucent one fades from r cos before the end to r cos after it and is half as dark (Beer-Lambert) a little past the middle. `contrast` (2,)
    tells which.
    """
    sine = np.clip(speed / px_per_m, 0.2, 1.0)
    opaque = 0.69 * np.clip((contrast - OPAQUE[0]) / (OPAQUE[1] - OPAQUE[0]), 0.0, 1.0)
    depth = -np.log1p(-np.clip(contrast, 0.01, 0.95))                   # mu 2 r
    half_dark = -np.log1p(-0.5 * np.clip(contrast, 0.01, 0.95)) / depth # share of the full path that takes half of it
    return np.maximum(opaque, 0.5 * (1 - 2 * half_dark)) * radius * np.sqrt(1 - sine**2) / sine


@dataclass(frozen=True)
class End:
    """Where a device ends along a curve."""

    at: float               # m, by both planes
    sigma: float            # m, if the planes agree
    seen_at: np.ndarray     # (2,) m, by each plane alone; NaN where it does not show the end
    seen_sigma: np.ndarray  # (2,) m

    @property
    def apart(self) -> float:
        """m by which the planes differ; 0 where only one shows the end."""
        return abs(float(np.nan_to_num(self.seen_at[0] - self.seen_at[1])))

    def honest_sigma(self, px_per_m: float) -> float:
        """sigma in m; where the planes disagree by more than noise, the truth lies somewhere between."""
        bounds = 3 * float(np.hypot(*self.seen_sigma)) + DISAGREE_PX / px_per_m
        return float(np.hypot(self.sigma, self.apart / 2)) if self.apart > bounds else self.sigma


def locate(s: np.ndarray, presence: np.ndarray, sigma: np.ndarray, speed: np.ndarray, guess: float, outward: int, beyond: np.ndarray,
           ramp: float = 0.0, density: float = 1.0, reach_px: float = REACH_PX) -> End:
    """Where the device ends.

    s: (N,) m. presence: (N, 2), sigma: (2,) its noise, speed: (N, 2) px per m. outward: +1 for the end at large s, -1 at small.
    beyond: (2,) m, see `bulge`. ramp: m over which the end fades in the more foreshortened plane; its model is worth RAMP of that.
    density: strips a px, so many of which are one observation. reach_px: how far from the guess it is looked for.
    Model: the blurred step a Phi((end + beyond - s) speed / blur), a and blur free in each plane; least squares over both planes, residuals
    clipped at 3.5 sigma.
    """
    px_per_m = np.mean(speed[int(np.argmin(np.abs(s - guess)))])
    near = np.abs(s - guess) * px_per_m < reach_px + 12
    rows = {v: near & np.isfinite(presence[:, v]) for v in range(2) if np.isfinite(sigma[v])}
    rows = {v: r for v, r in rows.items() if r.sum() >= 12}
    seen_at, seen_sigma = np.full(2, np.nan), np.full(2, np.nan)
    if not rows:
        return End(guess, float('inf'), seen_at, seen_sigma)

    def edges(v: int, end: np.ndarray, blurs) -> tuple[np.ndarray, np.ndarray, float]:
        """(E,) cost and information of edges at `end` in plane v, with the blur that fits best."""
        y, weight = presence[rows[v], v], 1 / (density * max(sigma[v], 0.02) ** 2)
        z = (outward * (end[:, None] - s[rows[v]]) + beyond[v]) * speed[rows[v], v]     # (E, n) px inside the device
        tried = []
        for blur in blurs:
            m = ndtr(z / blur)
            a = np.clip((m @ y) / np.maximum((m * m).sum(axis=1), 1e-9), 0.5, 1.8)
            cost = np.minimum((y - a[:, None] * m) ** 2 * weight * density, 12).sum(axis=1) / density
            slope = a[:, None] * np.exp(-0.5 * (z / blur) ** 2) / (blur * np.sqrt(2 * np.pi)) * speed[rows[v], v]
            tried.append((cost, (slope**2).sum(axis=1) * weight, blur))
        return min(tried, key=lambda t: t[0].min())

    model = (FLOOR_PX / px_per_m) ** 2 + (0.2 * beyond.mean()) ** 2 + (RAMP * ramp) ** 2
    wide = guess + np.arange(-reach_px, reach_px + 0.01, COARSE_PX) / px_per_m
    coarse = {v: edges(v, wide, BLURS_PX) for v in rows}
    for v, (cost, information, _) in coarse.items():
        seen_at[v], seen_sigma[v] = _lowest(wide, cost), np.sqrt(1 / (information[np.argmin(cost)] + 1e-12) + model)
    fine = wide[np.argmin(sum(c[0] for c in coarse.values()))] + np.arange(-1.0, 1.01, FINE_PX) / px_per_m
    seen = [edges(v, fine, [coarse[v][2]]) for v in rows]
    cost, information = sum(c for c, _, _ in seen), sum(i for _, i, _ in seen)
    return End(_lowest(fine, cost), float(np.sqrt(1 / (information[np.argmin(cost)] + 1e-12) + model)), seen_at, seen_sigma)


def _lowest(x: np.ndarray, y: np.ndarray) -> float:
    """Where the parabola through the lowest of (N,) values at even x and its neighbours is lowest."""
    k = min(max(int(np.argmin(y)), 1), len(y) - 2)
    left, middle, right = y[k - 1:k + 2]
    bow = left - 2 * middle + right
    return float(x[k] + (min(max(0.5 * (left - right) / bow, -1.0), 1.0) * (x[1] - x[0]) if bow > 0 else 0.0))
