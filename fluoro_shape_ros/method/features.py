"""What the images say of a fitted curve, in terms that mean the same on any display and at any dose.

How dark a line is on the curve is compared with how dark places beside it happen to be, so that gain, offset and noise
cancel; all else is a ratio, or in px.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np

from ..geometry.cameras import depth, pixels_per_metre
from ..geometry.curve import middle
from ..geometry.spline import Spline3, bending, through
from ..imaging.strips import Sheet, Strips, cut_at, lay_out, local_spread
from .fit.fit import MAX_HALF_WIDTH_PX
from .fit.result import Fit
from .fit.solver import BEND_SIGMA, REDUNDANCY

BLOCK = 12              # strips, along which darkness is averaged
WIDER, BLUR_PX = 1.2, 1.0  # half a line's width is taken as so many times that of the device, and so much more for blur
AROUND = 16             # blocks, whose surroundings tell the noise
PAST = 18               # strips looked at past either end
CLEAR = 2.5             # signal to noise, at which a block is darker than nearly all places beside the curve
MEAN, MEAN_PX = 0.3e-3, 1.0     # m, or px at the device: right is a curve whose closest-point mean is within the larger
                                # of these ...
TIP, TIP_PX = 1e-3, 3.0         # ... and its tip within the larger of these
PARTS, FEW = 3, 3       # of a device that are looked at apart for its width, of so many blocks at least
FAINTEST, CLEAREST = 0.3, 60.0      # signal to noise: less and more say no more
NEAR_END, PALE = 8, 0.2     # blocks, whose darkness is usual at an end, and the least of the usual that it is taken for
APART_PX, MOVED_PX = (0.1, 50.0), (0.1, 10.0)      # less and more say no more, too
FARTHEST = 50.0         # nats, that some 50 px of a device say that is seen beyond doubt
FAR_OFF_PX = 3.0        # of the device from the curve: more says no more
SKETCHED_PX = 2         # between the strips of a curve that was not fitted


@dataclass(frozen=True)
class Features:
    """Of one fit; of both planes the one that speaks against it, of both ends the tip's apart. Names are those in words
    of judge.REASONS."""

    weakest: float      # ln of the lowest signal to noise of three blocks in a row
    seen: float         # share of the blocks darker than nearly all places beside the curve
    symmetric: float    # odd part of the mean profile, as a share of its even part
    wide: float         # ln of the width seen to that expected, of the part where that is nearest to none,
                        # where it is wider ...
    narrow: float       # ... and the other way round
    residual: float     # px rms, of the device from the curve, averaged over blocks, beyond what noise explains
    sigma: float        # ln of the curve's, as a share of what it may be off by
    uneven: float       # ln of how abruptly it bends at most, beyond what is usual
    tip_stops: float    # how much darker it is before its tip than past it, as a share of its darkness around there
    base_stops: float   # as tip_stops
    tip_sigma: float    # ln of the tip's, as a share of what it may be off by
    base_sigma: float   # ln of the base's along the curve, in the same way
    tip_apart: float    # ln of how far apart the planes may see the tip, px; NaN where not both tell
    base_apart: float   # as tip_apart
    tip_aside: float    # darkness of a line beside where it would go on past its tip, as far as both planes show it:
                        # geometric mean
    tip_farther: float  # nats by which both planes show it going on past its tip, as a share of FARTHEST
    no_tip: float       # 1 where it leaves the field at both ends
    no_base: float      # 1 where it leaves the field at its base: that the planes see one end there speaks for a curve
    length: float       # ln of the share of an image's diagonal
    restless: float     # ln of px, that the fit still moved by in the end


NAMES = tuple(f.name for f in fields(Features))


def features(fit: Fit, sheet: Sheet, radius: float, tip_is_last: bool) -> np.ndarray:
    """(len(NAMES),) of a fit of a device of `radius` m."""
    step = fit.s[1] - fit.s[0]
    seen, count = _seen(fit.spline, fit.start, fit.stop, step, sheet, radius)
    tip = int(tip_is_last)
    stops = np.min([p['stops'] for p in seen], axis=0)
    stops[fit.open_end] = 1.0
    apart_px = _apart(fit) / step
    sigma = np.array([np.hypot(fit.end_sigma[tip], _across(fit, (fit.start, fit.stop)[tip])), fit.end_sigma[1 - tip]])
    tip_sigma, base_sigma = np.log(np.clip(sigma / max(TIP, TIP_PX * step), 0.01, 10.0))
    between = (fit.s > fit.start) & (fit.s < fit.stop)
    return np.array([
        *_everywhere(seen), max(_left_over(o[between]) for o in fit.offset_px.T),
        np.log(np.clip(np.sqrt(np.trace(fit.covariance) / len(fit.covariance)) / max(MEAN, MEAN_PX * step), 0.01, 100)),
        _uneven(fit), stops[tip], stops[1 - tip], 0.0 if fit.open_end[tip] else tip_sigma, base_sigma,
        *np.log(np.clip([apart_px[tip], apart_px[1 - tip]], *APART_PX)),
        np.sqrt(np.clip(fit.aside[tip], 0.0, 2.0).prod()), min(fit.farther[tip] / FARTHEST, 1.0),
        fit.open_end.all(), fit.open_end[1 - tip], np.log(count / _diagonal_px(sheet)),
        np.log(np.clip(fit.moved_px, *MOVED_PX))], float)


def _across(fit: Fit, s: float) -> float:
    """m, the standard deviation of where a fit runs at an arc length."""
    basis = fit.spline.bases(np.array([s]), 0)[0][0]
    return float(np.sqrt(sum(basis @ fit.covariance[k::3, k::3] @ basis for k in range(3))))


def _apart(fit: Fit) -> np.ndarray:
    """(2,) m by which the planes may see its first and its last end apart: their difference and its standard deviation;
    NaN where not both tell."""
    if fit.seen_at is None or fit.seen_sigma is None:
        return np.full(2, np.nan)
    return np.hypot(np.ptp(fit.seen_at, axis=1), np.hypot(*fit.seen_sigma.T))


def _left_over(offset_px: np.ndarray) -> float:
    """px rms of the means of blocks of (N,) offsets, NaN where not measured, beyond what their scatter within the
    blocks explains; at most FAR_OFF_PX, as where there is none."""
    blocks = offset_px[:len(offset_px) // BLOCK * BLOCK].reshape(-1, BLOCK)
    known = np.isfinite(blocks).sum(axis=1)
    blocks, known = blocks[known >= BLOCK // 2], known[known >= BLOCK // 2]
    if not len(blocks):
        return FAR_OFF_PX
    noise = REDUNDANCY * np.nanvar(blocks, axis=1) / (known - 1)
    return min(float(np.sqrt(max((np.nanmean(blocks, axis=1)**2 - noise).mean(), 0.0))), FAR_OFF_PX)


def _uneven(fit: Fit) -> float:
    """ln of the largest third derivative of a fit, beyond what its errors explain, as a share of BEND_SIGMA; 0 up to
    that. It is small on arcs, large where a curve leaves one line for another."""
    spline, n = fit.spline, len(fit.spline.control)
    piece = (spline.stop - spline.start) / (n - 3)
    begins = spline.start + piece * np.arange(n - 3)
    D = bending(n) / piece**3
    third, error = D @ spline.control, sum(np.einsum('ij,jk,ik->i', D, fit.covariance[k::3, k::3], D) for k in range(3))
    square = (third * third).sum(axis=1) - error
    return 0.5 * float(np.log(np.clip(square[(begins + piece > fit.start) & (begins < fit.stop)].max() / BEND_SIGMA**2,
                                      1, 1e4)))


def at_first_sight(points: np.ndarray, sheet: Sheet, radius: float) -> np.ndarray:
    """(len(NAMES),) of a curve (N, 3) in m, known to a few px, that was not fitted: NaN for what that cannot tell
    yet."""
    scale = [pixels_per_metre(v.P, points) for v in sheet.views]
    if radius * max(scale) > MAX_HALF_WIDTH_PX or min(depth(v.P, points).min() for v in sheet.views) <= 0:
        # it goes to a source
        return np.array([dict(weakest=np.log(FAINTEST), seen=0.0).get(name, np.nan) for name in NAMES])
    step = SKETCHED_PX / max(scale)
    spline = through(points, 0.0)
    seen, count = _seen(spline, spline.start, spline.stop, step, sheet, radius, round(BLOCK / SKETCHED_PX))
    known = dict(zip(NAMES, _everywhere(seen)), length=np.log(count * SKETCHED_PX / _diagonal_px(sheet)))
    return np.array([known.get(name, np.nan) for name in NAMES])


def _seen(spline: Spline3, start: float, stop: float, step: float, sheet: Sheet, radius: float,
          block: int = BLOCK) -> tuple[list[dict], int]:
    """What each plane shows of a curve between two arc lengths, and the number of strips between them, `step` m apart
    and `block` of them in a block."""
    count = max(int((stop - start) / step), block)
    s = np.linspace(start, stop, count)
    s = np.concatenate([start + step * np.arange(-PAST, 0), s, stop + step * np.arange(1, PAST + 1)])
    points, tangents = spline.lines(s)
    expected = [radius * pixels_per_metre(v.P, points[PAST:-PAST]) for v in sheet.views]
    half = [WIDER * (h + BLUR_PX) for h in expected]
    centers, normals, speed = lay_out(sheet.views, points, tangents)
    _go_straight_on(centers, normals)
    strips = cut_at(sheet, centers, normals, speed, float(np.ceil(5.5 * max(half) + 10)), rough=True)
    return [_plane(strips, v, half[v], expected[v], count, block) for v in (0, 1)], count


def _go_straight_on(centers: np.ndarray, normals: np.ndarray) -> None:
    """Lay the PAST strips beyond each end, (2, N, 2), along the line that each image shows before it: in space a curve
    may go on along a plane's rays, where that plane shows nothing of it."""
    for center, normal in zip(centers, normals):
        for c, n, way in ((center, normal, 1), (center[::-1], normal[::-1], -1)):       # from its first end, its last
            line = c[PAST:-PAST]
            before = line[min(int(np.searchsorted(np.hypot(*(line - line[0]).T), BLOCK)), len(line) - 1)]
            along = (line[0] - before) / max(float(np.hypot(*(line[0] - before))), 1e-9)
            c[:PAST] = line[0] + np.arange(PAST, 0, -1)[:, None] * along
            n[:PAST] = way * along[1], -way * along[0]


def _diagonal_px(sheet: Sheet) -> float:
    return float(max(np.hypot(v.width, v.height) for v in sheet.views))


def _everywhere(seen: list[dict]) -> tuple[float, ...]:
    """The features of what each plane shows along all of a curve, in the order of NAMES."""
    width = np.array([p['width'] for p in seen])
    return (np.log(np.clip(min(p['run'] for p in seen), FAINTEST, CLEAREST)), min(p['share'] for p in seen),
            max(p['odd'] for p in seen), max(width.max(), 0.0), max(-width.min(), 0.0))


def _plane(strips: Strips, v: int, half: float, radius_px: float, count: int, block: int) -> dict:
    """What plane `v` shows of a curve with `count` strips, `block` of them in a block, and PAST more past either
    end."""
    x, profiles = strips.offsets_px, strips.profiles[v]
    flank = (np.abs(x) > half + 0.5) & (np.abs(x) <= 2 * half + 2)
    width = int(np.ceil(2 * half + 2))
    kernel = np.zeros(2 * width + 1, np.float32)
    inner = np.abs(np.arange(-width, width + 1)) <= half
    outer = (np.abs(np.arange(-width, width + 1)) > half + 0.5)
    kernel[inner], kernel[outer] = -1 / inner.sum(), 1 / outer.sum()
    dark = cv2.filter2D(profiles, cv2.CV_32F, kernel[None], borderType=cv2.BORDER_REPLICATE)
    number = count // block
    blocks = dark[PAST:PAST + number * block].reshape(number, block, -1).mean(axis=1)
    beside = blocks[:, (np.abs(x) > 2.5 * half + 2) & (np.abs(x) < x[-1] - width + 1)]
    spread = local_spread(beside, AROUND)
    on = blocks[:, np.abs(x) <= 1].max(axis=1)
    usual = max(float(middle(on)), 1e-9)
    ratio = on / spread
    run = np.convolve(ratio, np.ones(3) / 3, 'valid') if number >= 3 else ratio
    near = np.abs(x) <= 2 * half + 2
    curve = np.vander(x, 3)
    mean = profiles[PAST:PAST + number * block].reshape(number, block, -1).mean(axis=1)
    shadow = (mean[:, flank] @ np.linalg.pinv(curve[flank]).T @ curve.T - mean)[:, near]
    even, _ = _typical(0.5 * (shadow + shadow[:, ::-1]))
    odd, odd_error = _typical(0.5 * (shadow - shadow[:, ::-1]))
    # tubes that end make steps: the part that comes nearest to the radius counts
    parts = np.array_split(shadow, PARTS) if number >= PARTS * FEW else [shadow]
    width = min((_width(p, x[near]) / np.hypot(radius_px / 2, BLUR_PX) for p in parts),
                key=lambda w: abs(np.log(max(w, 1e-3))))
    each = dark[:, np.abs(x) <= 1].max(axis=1)
    ends = np.array([(each[PAST:PAST + block].mean(), each[:PAST - 4].mean()),
                     (each[PAST + count - block:PAST + count].mean(), each[PAST + count + 4:].mean())])
    around = np.clip([middle(on[:NEAR_END]), middle(on[-NEAR_END:])], PALE * usual, usual)
    odd_share = np.sqrt(max((odd**2 - odd_error**2).sum(), 0.0) / ((even**2).sum() + 1e-12))
    return dict(run=float(run.min()), share=float((ratio > CLEAR).mean()), odd=min(float(odd_share), 2.0),
                width=float(np.log(np.clip(width, 0.3, 3.0))),
                stops=np.clip((ends[:, 0] - ends[:, 1]) / around, -1, 2))


def _width(shadow: np.ndarray, x: np.ndarray) -> float:
    """Standard deviation in px of the shadows (N, W) at (W,) offsets, as far as they are clear; a cylinder's chords
    have half its radius."""
    even, error = _typical(0.5 * (shadow + shadow[:, ::-1]))
    positive = even * np.clip(even / np.maximum(error, 1e-12) - 1.5, 0, 1)
    return float(np.sqrt((positive * x**2).sum() / (positive.sum() + 1e-12)))


def _typical(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(W,) median of (N, W) values, and the standard error of that, from their own scatter."""
    mid = middle(values, axis=0)
    return mid, 1.4826 * np.sqrt(np.pi / 2 / len(values)) * middle(np.abs(values - mid), axis=0)
