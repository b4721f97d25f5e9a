"""The 3-D spline fitted to both images at once.

Project the curve, cut strips across it in both images, see how far the device lies off in each, solve for the control points, repeat. Residuals
are perpendicular and sub-pixel, no correspondence is needed any more, and the normal equations carry the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .curve import arc_length
from .extent import bulge, locate, supported
from .geometry import pixels_per_metre
from .solver import Solution, solve
from .spline import Spline3, prolong, through
from .strips import Measurement, Strips, cut, half_width_range, likeness, mean_profile, measure, own_shadow, search, shadow

COARSE, FINE = 2, 3
COARSE_STEP = 3         # px between the strips of a coarse round
SETTLED_PX = 0.05       # a fine round that moves the curve less is the last
WIDE_PX = 8.0           # extra reach of the strips while the start is still rough
EXTENSION_PX = 26.0     # how far beyond the presumed ends is looked
NEAR_END_PX = 8
GROWTH, GROWTH_PX = 8, 30   # how often the curve may be prolonged, and by how much
END_WINDOW_PX, END_STEP_PX = 24.0, 0.5   # strips around an end
ASIDE = 0.8             # darkness beside the extension of a fit, as a share of the device's, that makes a tracked fit suspect
GOES_ON = 0.25          # darkness beyond an end, as a share of the usual, that makes one look farther


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
    reach = half_width_range(max(half_width))
    template = _shadows(half_width, np.arange(-reach, reach + 1))
    step = 1 / max(scale)
    spline = through(points, EXTENSION_PX * step)
    reference = (0.0, arc_length(points)[-1])
    grown, length_px = 0, 0.0
    rounds = [True] * coarse + [False] * FINE
    while rounds:
        wide = rounds.pop(0)
        s = np.arange(spline.start, spline.stop, COARSE_STEP * step if wide else step)
        strips = cut(images, fields, views, spline(s), spline(s, 1), reach + WIDE_PX if wide else reach)
        within = (s >= reference[0]) & (s <= reference[1])
        if wide:
            spline = solve(spline, s, strips, search(strips, template, smooth=3), views, within).spline
            continue
        own = np.stack([own_shadow(p, strips.offsets_px, within & i, e) for p, i, e in zip(strips.profiles, strips.inside, template)])
        seen = measure(strips, own, within)
        solution = solve(spline, s, strips, seen, views, within)
        spline = solution.spline
        stretch = supported(seen.presence.T)
        if stretch is None:
            return None
        settled = solution.moved_px < SETTLED_PX and np.abs(np.subtract(reference, (s[stretch[0]], s[stretch[1]]))).max() < 2 * step
        reference = (s[stretch[0]], s[stretch[1]])
        if (rounds and not settled) or grown == GROWTH:
            continue
        beyond = np.stack([_beyond(seen.presence.T, stretch[0], -1), _beyond(seen.presence.T, stretch[1], 1)])
        goes_on = [bool((b > GOES_ON).all()) for b in beyond]
        gained = (reference[1] - reference[0]) / step - length_px
        if any(goes_on) and (not grown or gained > NEAR_END_PX):        # look farther, as long as that finds something
            length_px = (reference[1] - reference[0]) / step
            spline, shift = prolong(spline, goes_on, GROWTH_PX * step)
            reference = (reference[0] + shift - goes_on[0] * GROWTH_PX * step, reference[1] + shift + goes_on[1] * GROWTH_PX * step)
            rounds, grown = [True] + [False] * (FINE - 1), grown + 1
        else:
            break
    found = _finish(solution, s, strips, seen, reference, beyond, half_width, radius)
    return _see_ends(images, fields, views, found, own, half_width, radius)


def _shadows(half_width, offsets_px: np.ndarray) -> np.ndarray:
    """(2, W) what a cylinder's shadow looks like in each plane."""
    return np.stack([shadow(h, offsets_px) for h in half_width])


def _beyond(presence: np.ndarray, at: int, outward: int) -> np.ndarray:
    """(2,) darkness that each plane shows just past strip `at`, as a share of the device's; NaN outside its field, 1 where the strips end before it does."""
    past = presence[at + 5:at + 22] if outward > 0 else presence[max(at - 21, 0):max(at - 4, 0)]
    if len(past) < 10:
        return np.where(np.isnan(past).any(axis=0), np.nan, 1.0)
    return np.median(past, axis=0)


def _finish(solution: Solution, s, strips: Strips, seen: Measurement, reference, beyond, half_width, radius) -> Fit:
    presence, inside, lit = seen.presence.T, strips.inside.T, strips.lit.all(axis=0)
    between = (s > reference[0]) & (s < reference[1])
    profile = [mean_profile(p, between & i) for p, i in zip(strips.profiles, strips.inside)]
    contrast = np.array([_contrast(p) for p in profile])
    scale = np.array(half_width) / radius
    across = 1 - (1 - contrast) ** np.clip(np.median(strips.speed[:, between], axis=1) / scale, 0.2, 1)     # Beer-Lambert: seen straight on
    alike = np.array([likeness(p, h) for p, h in zip(profile, half_width)])
    ends, open_end = list(reference), np.zeros(2, bool)
    for k, outward in enumerate((-1, 1)):
        i = min(int(np.searchsorted(s, reference[k])), len(s) - 1)
        past = inside[i:i + 14] if outward > 0 else inside[max(i - 14, 0):i + 1]
        if not past.all():    # it runs out of a field before its end could be seen
            open_end[k] = True
            dark = np.nonzero(~lit[i:] if outward > 0 else ~lit[:i + 1][::-1])[0]
            ends[k] = s[min(max(i + outward * (dark[0] - 1 if len(dark) else 0), 0), len(s) - 1)]
    covariance = np.linalg.inv(solution.information)
    return Fit(solution.spline, ends[0], ends[1], np.zeros(2), open_end, covariance, s, presence, solution.offset_px.T, contrast, across, alike, np.nan_to_num(beyond))


def _see_ends(images, fields, views, f: Fit, own: np.ndarray, half_width, radius: float) -> Fit:
    """The fit with its ends located; `own` (2, W) is the device's profile in each plane.

    Twice, the second time by strips laid out from the end that the first has found: where strips happen to lie must not count.
    """
    scale, step = np.array(half_width) / radius, f.s[1] - f.s[0]
    ends, sigma = np.array([f.start, f.stop]), f.end_sigma.copy()
    window = np.arange(-END_WINDOW_PX, END_WINDOW_PX + END_STEP_PX, END_STEP_PX) * step
    reach = (own.shape[1] - 1) // 2
    for k in np.nonzero(~f.open_end)[0]:
        outward = (-1, 1)[k]
        for _ in range(2):
            s = ends[k] + window
            strips = cut(images, fields, views, f.spline(s), f.spline(s, 1), reach)
            seen = measure(strips, own, outward * (s - ends[k]) < 0)
            speed = strips.speed.T
            sine = np.clip(speed[len(s) // 2] / scale, 0.1, 1.0)
            ends[k], sigma[k] = locate(s, seen.presence.T, seen.presence_sigma, speed, ends[k], outward, bulge(radius, speed[len(s) // 2], scale, f.across),
                                       radius / float(np.tan(np.arcsin(sine)).min()), 1 / END_STEP_PX)
    return replace(f, start=float(ends[0]), stop=float(ends[1]), end_sigma=sigma)


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
    reach, px = half_width_range(max(half_width)), np.arange(-80, 20)
    for k, (end, outward) in enumerate(((f.start, -1), (f.stop, 1))):
        if not f.open_end[k]:
            s = end + outward * px * step
            strips = cut(images, fields, views, f.spline(s), f.spline(s, 1), reach + WIDE_PX)
            line = search(strips, _shadows(half_width, np.arange(-reach, reach + 1)))
            if np.median(line.presence[:, (px > 6) & (px < 18)], axis=1).max() > ASIDE:
                return True
    return False
