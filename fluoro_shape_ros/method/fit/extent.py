"""Where the device begins and ends on a curve that has come to rest, as both planes see it, and what that tells of the
curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...data import View
from ...geometry.cameras import projection_jacobian, slant
from ...geometry.curve import middle
from ...geometry.spline import Spline3
from .ends import BLURS_PX, OUTWARD, SMOOTH_PX, End, level, locate, past_band
from .opacity import bulge, exponent, of_part, rim
from .result import Fit, Rest

# strips around an end, and how far from the first guess it is looked for
END_WINDOW_PX, END_STEP_PX, END_REACH_PX = 16.0, 0.5, 2.0
AGREE = 1.5             # standard deviations by which the planes' ends differ at most, that tell the depth of a curve
BARE, HIDES = 0.25, 0.6         # darkness past an end or aside, in a plane that shows it well, and in one where another
                                # line may hide it ...
CROSSES = 0.5           # ... that goes across, so that straight on it is less dark
CROWDED = 0.4           # darkness aside in both planes, that makes an end hard to see
HARD_PX = 1.0           # what an end is worth that only one plane shows, or that is hard to see in both


def extent(found: Rest, aside: np.ndarray, farther: np.ndarray, look: Callable, views: Sequence[View],
           radius: float) -> Fit:
    """The fit of a device of `radius` m that a curve at rest makes, with its ends and what they tell of it.

    aside, farther: see Fit. look: strips across a fit at arc lengths, and what they say.
    """
    f, ends = _first_extent(found, aside, farther, views, radius)
    f = replace(f, covariance=_confirmed(f, ends, views))
    return _see_ends(look, f, ends, views, radius, *found.at_ends, found.typical)


def _first_extent(found: Rest, aside: np.ndarray, farther: np.ndarray, views: Sequence[View],
                  radius: float) -> tuple[Fit, list[End | None]]:
    """The fit, and its ends where they are seen, by the strips that it was fitted to."""
    s, strips, seen, reference, solution = found.layout.s, found.strips, found.measured, found.reference, found.solution
    presence, inside, lit = seen.presence.T, strips.inside.T, strips.lit.all(axis=0)
    between = (s > reference[0]) & (s < reference[1])
    at = np.minimum(np.searchsorted(s, reference), len(s) - 1)
    # it runs out of a field before its end
    open_end = np.array([not inside[max(at[0] - 14, 0):at[0] + 1].all(), not inside[at[1]:at[1] + 14].all()])
    twice = lambda x: np.broadcast_to(x, (2, *x.shape))     # noqa: E731
    inward = OUTWARD[:, None] * (np.array(reference)[:, None] - s)
    usual, beside = found.at_ends
    noise = np.maximum(seen.presence_sigma, np.sqrt(SMOOTH_PX) * beside / np.nan_to_num(usual, nan=1e-9))
    sine = _slants(solution.spline, s, views)
    fade = rim(radius, sine[:, at].T)
    height, inner = _levels(twice(seen.presence), inward, s[1] - s[0], twice(seen.presence_sigma), fade)
    power = exponent(seen.presence * seen.usual, sine, inside.T & between)
    at_ends = of_part(power, height * usual / found.typical)
    located = locate(twice(s), twice(seen.presence) / height[..., None], noise / height, twice(strips.speed),
                     np.array(reference), OUTWARD, bulge(radius, sine[:, at].T, at_ends), fade,
                     blurs_px=BLURS_PX[1:2], inner=inner)
    start_stop, ends = [end.at for end in located], list[End | None](located)
    for k in np.nonzero(open_end)[0]:
        dark = np.nonzero(~lit[at[k]:] if k else ~lit[:at[k] + 1][::-1])[0]
        start_stop[k] = s[min(max(at[k] + OUTWARD[k] * (dark[0] - 1 if len(dark) else 0), 0), len(s) - 1)]
        ends[k] = None
    start, stop = start_stop
    return Fit(solution.spline, start, stop, np.zeros(2), open_end, solution.covariance(), s, presence,
               solution.offset_px.T, power, np.where(np.isnan(beyond := found.beyond), 0.0, beyond),
               np.where(open_end[:, None], 0.0, aside), np.where(open_end, 0.0, farther), np.full(2, -1),
               solution.moved_px), ends


def _levels(presence: np.ndarray, inward: np.ndarray, px: float, sigma: np.ndarray,
            fade: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2, 2) and (2,) of ends.level for both ends (rows): of (2, 2, N) presence with (2, 2) noise, at (2, N) arc
    lengths inside them, m, which fade over (2, 2) m."""
    height, inner = zip(*(level(p, i, px, n, f) for p, i, n, f in zip(presence, inward, sigma, fade)))
    return np.array(height), np.array(inner)


def _confirmed(f: Fit, ends: Sequence[End | None], views: Sequence[View]) -> np.ndarray:
    """(3 n, 3 n) covariance of a fit whose ends both planes see at one place, as far as they see it: a curve that runs
    in an epipolar plane is seen across itself by neither, but its ends tell its depth. Where they differ by more, one
    of them may be another edge, which tells nothing.

    Moved by dX at its end, plane v sees that end at s_v - t_v J_v dX / |J_v X'|, t_v along the projected curve.
    """
    covariance = f.covariance
    for end, by in zip(ends, _shown_by_one(f)):
        if end is None or by >= 0 or not end.apart < AGREE * np.hypot(*end.seen_sigma):
            continue
        (basis,), (slope,) = f.spline.bases(np.array([end.at]), 0, 1)
        X, T = basis @ f.spline.control, slope @ f.spline.control
        a, b = ((J @ T) @ J / max((J @ T) @ (J @ T), 1e-9) for J in (projection_jacobian(v.P, X) for v in views))
        row = (basis[:, None] * (a - b)).ravel()
        told = covariance @ row
        covariance = covariance - np.outer(told, told) / (row @ told + end.seen_sigma @ end.seen_sigma)  # Kalman 1960
    return covariance


def _slants(spline: Spline3, s: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """(V, N) sine of the angle at which each plane sees a curve at (N,) arc lengths."""
    points, tangents = spline.lines(s)
    return np.stack([slant(v.P, points, tangents) for v in views])


def _see_ends(look: Callable, f: Fit, ends: list[End | None], views: Sequence[View], radius: float,
              usual: np.ndarray, clutter: np.ndarray, typical: np.ndarray) -> Fit:
    """The fit with its ends seen once more, by strips laid out from where they are: where strips happen to lie must not
    count. usual, clutter: (2, 2) at each end (rows) in each plane, typical: (2,) along the curve, see Rest."""
    step, by = f.s[1] - f.s[0], _shown_by_one(f)
    alone = np.array([v if end is not None and v >= 0 and np.isfinite(end.seen_at[v]) and end.disagreed else -1
                      for end, v in zip(ends, by)])
    at = np.array([x if end is None or v < 0 else end.seen_at[v] for end, v, x in zip(ends, alone, (f.start, f.stop))])
    window = np.arange(-END_WINDOW_PX, END_WINDOW_PX + END_STEP_PX, END_STEP_PX) * step
    s = at[:, None] + window
    strips, seen = look(f, s, OUTWARD[:, None] * window < 0)
    # (ends, planes, strips)
    presence, speed = (x.reshape(2, 2, -1).transpose(1, 0, 2) for x in (seen.presence, strips.speed))
    sine = _slants(f.spline, at, views).T
    # (ends, planes)
    local = np.nan_to_num(middle(seen.usual), nan=1e-9).reshape(2, 2).T
    noise = np.maximum(seen.presence_sigma.reshape(2, 2).T, np.sqrt(SMOOTH_PX) * clutter / local)
    fade = rim(radius, sine)
    height, inner = _levels(presence, -OUTWARD[:, None] * window, step, seen.presence_sigma.reshape(2, 2).T, fade)
    again = locate(s, presence / height[..., None], noise / height, speed, at, OUTWARD,
                   bulge(radius, sine, of_part(f.power, height * local / typical)), fade, density=1 / END_STEP_PX,
                   reach_px=END_REACH_PX, inner=inner)
    guess, hard, sigma = at.copy(), crowded(f), np.zeros(2)
    for k, (end, v) in enumerate(zip(ends, alone)):
        if v >= 0 and np.isfinite(again[k].seen_at[v]):
            at[k], sigma[k], hard[k] = again[k].seen_at[v], again[k].seen_sigma[v], True
        elif end is not None and end.sigma > END_REACH_PX * step:
            sigma[k] = end.honest_sigma     # more of the device tells it than the strips around it
        elif end is not None:
            at[k], sigma[k] = again[k].at, replace(end, sigma=again[k].sigma).honest_sigma
        if end is not None and inner[k] < np.inf:
            further, unsure = past_band(f.presence.T, OUTWARD[k] * (at[k] - f.s),
                                        float(inner[k] + OUTWARD[k] * (at[k] - guess[k])),
                                        clutter[k] / np.nan_to_num(usual[k], nan=1e-9), rim(radius, sine[k]), step)
            at[k], sigma[k] = at[k] + OUTWARD[k] * further, np.hypot(sigma[k], unsure)
    sigma[hard] = np.hypot(sigma[hard], HARD_PX * step)
    sigma = np.minimum(sigma, f.stop - f.start)     # an end that no plane shows lies somewhere along the curve
    told = [(end.seen_at, end.seen_sigma) if end is not None and v < 0 and not h else np.full((2, 2), np.nan)
            for end, v, h in zip(ends, by, hard)]
    return replace(f, start=float(at[0]), stop=float(at[1]), end_sigma=sigma * ~f.open_end, alone=alone,
                   seen_at=np.stack([place for place, _ in told]), seen_sigma=np.stack([unsure for _, unsure in told]))


def _shown_by_one(f: Fit) -> np.ndarray:
    """(2,) the plane that shows the first and the last end well where a line that crosses the device may hide it in the
    other; -1 where there is none."""
    dark = np.maximum(f.beyond, f.aside)
    hidden = (dark.min(axis=1) < BARE) & (dark.max(axis=1) > HIDES) & (f.beyond.max(axis=1) < CROSSES) & ~f.open_end
    return np.where(hidden, dark.argmin(axis=1), -1)


def crowded(f: Fit) -> np.ndarray:
    """(2,) bool: whether both planes show something beside where the first and the last end would go on."""
    return f.aside.min(axis=1) > CROWDED
