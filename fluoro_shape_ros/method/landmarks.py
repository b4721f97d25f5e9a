"""Places of a fitted device that each plane shows by itself, whatever the other plane's calibration: its ends, its
steps and bands, and where it runs along its epipolar line.

A fit takes up an error of the calibration elsewhere: it moves in depth until it lies on the device in both images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ..data import Landmarks, View
from ..geometry.cameras import epipolar_lines, fundamental
from ..geometry.curve import middle
from ..imaging.strips import lay_out
from .fit.result import Fit

FAR_PX = 10.0           # from the fit's end: there a plane hardly looked for it, and found something else
AROUND = 13             # strips, that tell how far the device lies beside the curve
ALONG_LINE = 0.15       # sine of the angle to its epipolar line, up to which the device runs along it ...
SHORTEST = 6            # ... for so many strips
ACROSS_LINE = 0.4       # ... and from which on bands along the device tell something
FINE, BROAD = 2.0, 12.0 # strips: how wide bands are, between
APART_PX = np.arange(-8, 8.1, 0.5)      # that bands may lie from where they should be
SHOWN = 0.06            # of the device's darkness, by which bands must change it in both planes
ALIKE = 0.5             # correlation of both planes' bands, from which on they are the same
STEPS_PX = 0.8          # what bands tell of that (measured)
ENDS = 20               # strips, that are left out of the bands

# kind, (2,) px in plane A, in plane B, and (2,) slack, see Landmarks
Place = tuple[str, np.ndarray, np.ndarray, np.ndarray]


def landmarks(f: Fit, views: Sequence[View], tip_is_last: bool) -> Landmarks:
    """Those of a fit, in the pixels of the `views`."""
    F = fundamental(views[0].P, views[1].P)
    found = list(chain(_ends(f, views, tip_is_last), _along(f, views, F)))
    kinds, points = tuple(kind for kind, *_ in found), np.array([rest for _, *rest in found]).reshape(-1, 3, 2)
    return Landmarks(kinds, *points.transpose(1, 0, 2))


def _ends(f: Fit, views: Sequence[View], tip_is_last: bool) -> Iterator[Place]:
    """The ends that both planes show."""
    for k, outward in enumerate((-1, 1)):
        if f.seen_at is None or f.seen_sigma is None or not np.isfinite([f.seen_at[k], f.seen_sigma[k]]).all():
            continue
        centers, normals, speed = lay_out(views, *f.spline.lines(f.seen_at[k]))     # strip v where plane v sees the end
        if (np.abs(f.seen_at[k] - (f.start, f.stop)[k]) * np.diag(speed) > FAR_PX).any():
            continue
        near = np.argsort(np.abs(f.s - np.clip(f.seen_at[k].mean(), f.start, f.stop)))[:AROUND]
        a, b = (centers[v, v] + normals[v, v] * _usual(f.offset_px[near, v]) for v in (0, 1))
        yield ('tip' if k == int(tip_is_last) else 'base', a, b,
               outward * _tangents(normals[1, 1]) * speed[1, 1] * np.hypot(*f.seen_sigma[k]))


def _along(f: Fit, views: Sequence[View], F: np.ndarray) -> Iterator[Place]:
    """The bends, whose slack is 0, and all steps together."""
    within = (f.s > f.start) & (f.s < f.stop)
    if not within.any():
        return
    centers, normals, speed = lay_out(views, *f.spline.lines(f.s))
    lines = epipolar_lines(F, centers[0])[:, :2]
    sine = (lines * _tangents(normals[1])).sum(axis=1)
    level = np.flatnonzero(within & np.isfinite(f.offset_px).all(axis=1) & (np.abs(sine) < ALONG_LINE))
    for run in np.split(level, np.flatnonzero(np.diff(level) > 1) + 1):
        if len(run) >= SHORTEST:
            flattest, weights = run[np.abs(sine[run]).argmin()], 1 - (sine[run] / ALONG_LINE) ** 2
            beside = weights @ f.offset_px[run] / weights.sum()
            a, b = (centers[v, flattest] + normals[v, flattest] * beside[v] for v in (0, 1))
            yield 'bend', a, b, np.zeros(2)
    apart = _bands_apart(f, sine * speed[1])
    if apart is not None:
        steepest = int(np.abs(sine * within).argmax())
        along = _tangents(normals[1, steepest]) / sine[steepest]
        yield 'steps', centers[0, steepest], centers[1, steepest] + apart * along, STEPS_PX * along


def _bands_apart(f: Fit, across: np.ndarray) -> float | None:
    """px across the epipolar lines by which plane B shows the device's bands and steps from where plane A does; None
    where there are none.

    across: (N,) px per m that its image in plane B runs across them.
    """
    step = f.s[1] - f.s[0]
    counts = ((f.s > f.start + ENDS * step) & (f.s < f.stop - ENDS * step)
              & (np.abs(across) > ACROSS_LINE * np.abs(across).max()))
    if counts.sum() < 4 * BROAD:
        return None
    dark = np.where(np.isfinite(f.presence), np.clip(f.presence, -1, 4), 1.0)
    a, b = (gaussian_filter1d(dark, FINE, axis=0) - gaussian_filter1d(dark, BROAD, axis=0)).T
    if min(a[counts].std(), b[counts].std()) < SHOWN:
        return None
    moved = np.interp(f.s[counts] + APART_PX[:, None] / across[counts], f.s, b)
    alike = moved @ a[counts] / np.maximum(np.linalg.norm(moved, axis=1) * np.linalg.norm(a[counts]), 1e-9)
    k = int(alike.argmax())
    if alike[k] < ALIKE or not 0 < k < len(alike) - 1:
        return None
    left, top, right = alike[k - 1:k + 2]
    return float(APART_PX[k] + 0.5 * (left - right) / (left - 2 * top + right) * (APART_PX[1] - APART_PX[0]))


def _tangents(normals: np.ndarray) -> np.ndarray:
    """(..., 2) unit tangents, in the direction of the curve, of (..., 2) normals of strips."""
    return np.stack([normals[..., 1], -normals[..., 0]], axis=-1)


def _usual(offset_px: np.ndarray) -> float:
    known = offset_px[np.isfinite(offset_px)]
    return float(middle(known)) if len(known) else 0.0
