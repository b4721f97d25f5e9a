"""A fit measured once more on the outlines that were segmented: how they scatter says how uncertain it is, and their
ends are what they are.

Of an opaque device the outline reaches beyond the end of its axis by half the ellipse that a flat end's rim is, seen at
an angle, and by as much as it is too thick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from ..geometry.cameras import pixels_per_metre
from ..geometry.curve import middle
from ..imaging.strips import Model, Sheet, Strips, cut, measure, search
from .fit.result import Fit
from .fit.solver import Layout, solve

LOOKS = search, measure, measure    # across the curve: a sharp edge tells how far it is off only where that is not far
FOUND_OVER = 5          # strips, together, in which the device is looked for first
EDGE_PX = 0.5           # blur of an outline's edge, sampled between pixels
# along the curve, at least and at most, that tell how thick and jagged an outline is beside its end
BESIDE_PX, LONGEST_PX = 60, 400
FEWEST = 20             # strips that do
GONE = 0.3              # of the width: more is left where an outline goes on
TOO_THICK_PX = 1.5      # standard deviation of what an outline is too thick or too thin ...
RADIUS_OFF = 0.1        # ... and of what is known of the device's radius, as a share
PIXEL_PX = 0.3          # what the end of an outline of pixels is worth at best
RIM = 0.15              # share of the rim that its model is worth
CORNER_PX = 1.0         # by which a segmentation makes corners round
# from which half width on a round end is told from corners that are, and nats that must speak for two;
# twice as many for one
ROUND_PX, SURE = 6.0, 5.0
TOGETHER_PX = 3.0       # along which an outline's edge errs the same way
FINE_PX = 0.2           # steps in which an end is looked for


def on_outlines(outlines: Sheet, f: Fit, radius: float) -> Fit:
    """The fit brought to rest on the outlines (1 in the device, 0 beside it) of a device of `radius` m; itself where
    they show nothing along it."""
    for look in LOOKS:
        settled = _across(outlines, f, radius, look)
        if settled is None:
            return f
        f = _ended(outlines, settled, radius)
    return f


def _across(outlines: Sheet, f: Fit, radius: float, look: Callable) -> Fit | None:
    """The curve in the middle of both outlines, by `look` (imaging.strips)."""
    layout = Layout.of(f.spline, f.s[1] - f.s[0])
    margin = min(radius, 0.1 * (f.stop - f.start))      # an end's corners may be missing on one side
    within = (layout.s > f.start + margin) & (layout.s < f.stop - margin)
    strips = _cut(outlines, layout.basis @ f.spline.control, layout.slope @ f.spline.control, radius)
    half = np.array([middle(w[within]) / 2 for w in _widths(strips)] if np.count_nonzero(within) > FEWEST else [0.0])
    if min(half) < 0.5:
        return None
    x, half = strips.offsets_px, np.minimum(half, 0.5 * strips.offsets_px[-1])
    profile = np.stack([ndtr((x + h) / EDGE_PX) - ndtr((x - h) / EDGE_PX) for h in half])
    dark = replace(strips, profiles=1 - strips.profiles)
    if look is search:
        measured = search(dark, profile[:, np.abs(x) <= max(half) + 2], smooth=FOUND_OVER)
    else:
        measured = measure(dark, Model.of(profile, x), within)
    solution = solve(layout, f.spline, dark, measured, outlines.views, within)
    return replace(f, spline=solution.spline, covariance=solution.covariance(), s=layout.s,
                   offset_px=solution.offset_px.T)


def _cut(outlines: Sheet, points: np.ndarray, tangents: np.ndarray, radius: float) -> Strips:
    half_width = radius * max(pixels_per_metre(v.P, points) for v in outlines.views)
    return cut(outlines, points, tangents, float(np.ceil(2 * half_width + 4)), rough=True)


def _widths(strips: Strips) -> np.ndarray:
    """(2, N) px of each outline across the curve."""
    return np.minimum(np.maximum(strips.profiles, 0), 1).sum(axis=2)


@dataclass(frozen=True)
class _Seen:
    """What one outline shows of one end; places in m from the fit's end outwards."""

    flat: float             # where the axis ends, if the device is cut off straight
    centre: float           # where the centre is, if the outline ends in a half circle
    round: float            # nats by which it speaks for that half circle
    outline: float          # px, half its width
    device: float           # px, half the device's width
    sigma: float            # px, of either place ...
    flat_sigma: float       # px, ... and of the flat end besides, if the rim is not what it should be ...
    common: float           # px, ... or the radius is not, which all outlines share
    speed: float            # px per m along the curve


def _ended(outlines: Sheet, f: Fit, radius: float) -> Fit:
    """The fit with its ends where the outlines show them; where these do not, as they were."""
    ends = [[] if f.open_end[k] else _seen(outlines, f, radius, k) for k in (0, 1)]
    speak = [sum(e.round if e.outline > ROUND_PX else -SURE for e in seen) for seen in ends]
    drawn = all(ends) and sum(speak) > SURE and min(speak) > -SURE  # with a round brush, from end to end of the axis
    at, sigma, alone = np.array([f.start, f.stop]), f.end_sigma.copy(), f.alone.copy()
    seen_at, seen_sigma = np.full((2, 2, 2), np.nan)
    for k, (seen, outward) in enumerate(zip(ends, (-1, 1))):
        if seen:
            # One round end of two is the device's own; of a single one in sight nobody can tell.
            apex = 0.0 if drawn else None if speak[k] < 2 * SURE else 1.0 if ends[1 - k] else 0.5
            past, sigma[k] = _joint(seen, apex)
            if len(seen) == 2:
                by_each = np.array([_joint([e], apex) for e in seen])
                seen_at[k], seen_sigma[k] = at[k] + outward * by_each[:, 0], by_each[:, 1]
            at[k] += outward * past
            alone[k] = -1 if len(seen) == 2 else alone[k]
    ended = replace(f, start=float(at[0]), stop=float(at[1]), end_sigma=sigma, alone=alone, seen_at=seen_at,
                    seen_sigma=seen_sigma)
    return ended if at[1] - at[0] > radius else replace(f, seen_at=None, seen_sigma=None)


def _seen(outlines: Sheet, f: Fit, radius: float, k: int) -> list[_Seen]:
    """What each outline shows of the first (k = 0) or last end; without those that do not end there."""
    views, step, end, outward = outlines.views, f.s[1] - f.s[0], (f.start, f.stop)[k], (-1, 1)[k]
    scale = [pixels_per_metre(v.P, f.spline(np.array([end]))) for v in views]
    half_width = radius * max(scale)
    # strips before the end and past it, among which the outline may end
    inner, outer = int(1.5 * half_width + 6), int(3 * half_width + 14)
    count = min(inner + max(BESIDE_PX, min(int(8 * half_width), LONGEST_PX)), int((f.stop - f.start) / step))
    first = count - inner
    if first < FEWEST:
        return []
    past = step * np.arange(-count, outer)
    on = np.clip(end + outward * past, f.start, f.stop)
    points, tangents = f.spline.lines(on)
    # straight on past the end
    strips = _cut(outlines, points + (end + outward * past - on)[:, None] * tangents, tangents, radius)
    found = []
    for v, width in enumerate(_widths(strips)):
        usual, speed = float(middle(width[:first])), float(strips.speed[v, count])
        if usual < 1 or middle(width[-FEWEST // 2:]) > GONE * usual:
            continue
        h, expected, share = usual / 2, radius * scale[v], width / usual
        off = RADIUS_OFF * expected
        excess = (h - expected) * TOO_THICK_PX**2 / (TOO_THICK_PX**2 + off**2)
        device = max(h - excess, 0.5 * h)
        rim = device * np.sqrt(1 - np.clip(speed / scale[v], 0.2, 1.0)**2)
        corner = min(max(excess, 0) + CORNER_PX, h / 2)
        px = past[first:] * speed
        (flat, cost), (centre, cost_round) = (_where(px, share[first:], _end_of(h, *shape))
                                              for shape in ((rim, corner), (h, 0.0)))
        noise = max(float(np.var(share[:first])), (PIXEL_PX / usual)**2)
        found.append(_Seen((flat + corner - excess) / speed, centre / speed,
                           (cost - cost_round) / (2 * TOGETHER_PX * noise), h, device,
                           float(np.hypot(PIXEL_PX, _jagged(strips.profiles[v, :first], usual / (step * speed)))),
                           RIM * rim, TOO_THICK_PX * off / np.hypot(TOO_THICK_PX, off), speed))
    return found


def _end_of(half_width: float, rim: float, corner: float) -> np.ndarray:
    """(N,) width, as a share, of an outline at px FINE_PX apart, centred on 0, from which on it gets narrower: a
    cylinder's end, of whose rim an ellipse is seen that reaches so far, drawn with a pen that makes corners so round (a
    Minkowski sum, by its normals)."""
    a, b, normal = rim, half_width - corner, np.linspace(0, np.pi / 2, 200)
    across = np.sqrt((a * np.cos(normal))**2 + (b * np.sin(normal))**2) + 1e-9
    x, y = (a * a * np.cos(normal) / across + corner * np.cos(normal),
            b * b * np.sin(normal) / across + corner * np.sin(normal))
    reach = FINE_PX * np.ceil((rim + corner + 4) / FINE_PX)
    at = np.arange(-reach, reach + FINE_PX / 2, FINE_PX)
    width = np.where(at < 0, 1.0, np.interp(at, x[::-1], y[::-1], right=0.0) / half_width)
    return gaussian_filter1d(width, EDGE_PX / FINE_PX, mode='nearest')


def _where(px: np.ndarray, share: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Where `shape` (_end_of) is most like (N,) widths, as shares, at (N,) px, by least squares; and the sum of their
    squares."""
    reach = FINE_PX * (len(shape) // 2)
    places = np.arange(px[0], px[-1], FINE_PX)
    model = np.interp(px - places[:, None], np.linspace(-reach, reach, len(shape)), shape)
    cost = ((np.minimum(share, 1.2) - model)**2).sum(axis=1)
    best = int(cost.argmin())
    return float(places[best]), float(cost[best])


def _jagged(profiles: np.ndarray, count: float) -> float:
    """px: standard deviation of an outline's edge, averaged over `count` of its (N, W) strips, as an end is over its
    width."""
    inside, half = np.minimum(np.maximum(profiles, 0), 1), profiles.shape[1] // 2
    sides = np.stack([inside[:, :half].sum(axis=1), inside[:, half + 1:].sum(axis=1)])
    mean = cv2.blur(sides - sides.mean(axis=1, keepdims=True), (max(round(count), 1), 1))
    return float(np.sqrt(np.mean(mean**2)))


def _joint(seen: list[_Seen], apex: float | None) -> tuple[float, float]:
    """m from the fit's end outwards to where the device ends, and its standard deviation.

    apex: None for a flat end, else where on the way from the centre of a round one to its apex the axis ends.
    """
    speed = np.array([e.speed for e in seen])
    if apex is None:
        past, own, common = np.array([(e.flat, np.hypot(e.sigma, e.flat_sigma), e.common) for e in seen]).T
    else:
        past, own, common = np.array([(e.centre + apex * e.device / e.speed, e.sigma, 0.5 * e.device * (apex == 0.5))
                                      for e in seen]).T
    own, common = own / speed, common / speed
    weight = 1 / own**2 / np.sum(1 / own**2)
    apart = float(((past - weight @ past)**2 / own**2).sum())  # chi-squared with one degree of freedom, of two outlines
    return float(weight @ past), float(np.hypot(np.sqrt(max(1.0, apart) / np.sum(1 / own**2)), weight @ common))
