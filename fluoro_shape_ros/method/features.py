"""What the images say of a fitted curve, in terms that mean the same on any display and at any dose.

How dark a line is on the curve is compared with how dark places beside it happen to be, so that gain, offset and noise cancel; all else is a ratio, or in px.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np

from ..geometry.cameras import pixels_per_metre
from ..geometry.curve import middle
from ..imaging.strips import Sheet, Strips, cut
from .fit.fit import Fit

BLOCK = 12              # strips, along which darkness is averaged
WIDER, BLUR_PX = 1.2, 1.0       # half a line's width is taken as so many times that of the device, and so much more for blur
PAST = 18               # strips looked at past either end
CLEAR = 2.5             # signal to noise, at which a block is darker than nearly all places beside the curve
MEAN, MEAN_PX = 0.3e-3, 1.0     # m, or px at the device: right is a curve whose closest-point mean is within the larger of these ...
TIP, TIP_PX = 1e-3, 3.0         # ... and its tip within the larger of these
FAINTEST, CLEAREST = 0.3, 60.0      # signal to noise: less and more say no more


@dataclass(frozen=True)
class Features:
    """Of one fit; of both planes the one that speaks against it, of both ends the tip's apart. Names are those in words of judge.REASONS."""

    weakest: float      # ln of the lowest signal to noise of three blocks in a row
    seen: float         # share of the blocks darker than nearly all places beside the curve
    symmetric: float    # odd part of the mean profile, as a share of its even part
    width: float        # |ln| of the width seen to that expected
    residual: float     # px rms, of the device from the curve
    sigma: float        # ln of the curve's, as a share of what it may be off by
    tip_stops: float    # how much darker it is before its tip than past it, as a share of its darkness
    tip_shown: float    # darkness of its last BLOCK before the tip, as a share of its darkness
    tip_sigma: float    # ln of the tip's along the curve, as a share of what it may be off by
    tip_aside: float    # darkness of a line beside where it would go on
    no_tip: float       # 1 where it leaves the field at both ends
    length: float       # ln px
    hidden: float       # ends that only one plane shows


NAMES = tuple(f.name for f in fields(Features))


def features(fit: Fit, sheet: Sheet, radius: float, tip_is_last: bool) -> np.ndarray:
    """(len(NAMES),) of a fit of a device of `radius` m."""
    step = fit.s[1] - fit.s[0]
    count = max(int((fit.stop - fit.start) / step), BLOCK)
    s = np.linspace(fit.start, fit.stop, count)
    s = np.concatenate([fit.start + step * np.arange(-PAST, 0), s, fit.stop + step * np.arange(1, PAST + 1)])
    points, tangents = fit.spline.lines(s)
    expected = [radius * pixels_per_metre(v.P, points[PAST:-PAST]) for v in sheet.views]
    half = [WIDER * (h + BLUR_PX) for h in expected]
    strips = cut(sheet, points, tangents, float(np.ceil(5.5 * max(half) + 10)), rough=True)
    seen = [_plane(strips, v, half[v], expected[v], count) for v in (0, 1)]
    tip = int(tip_is_last)
    stops = np.min([p['stops'] for p in seen], axis=0)
    shown = np.min([p['shown'] for p in seen], axis=0)
    stops[fit.open_end], shown[fit.open_end] = 1.0, 1.0
    tip_sigma = np.log(np.clip(fit.end_sigma[tip] / max(TIP, TIP_PX * step), 0.01, 10.0))
    between = (fit.s > fit.start) & (fit.s < fit.stop)
    left = [np.sqrt(np.nanmean(o[between]**2)) if np.isfinite(o[between]).any() else 3.0 for o in fit.offset_px.T]
    return np.array([
        np.log(np.clip(min(p['run'] for p in seen), FAINTEST, CLEAREST)), min(p['share'] for p in seen), max(p['odd'] for p in seen),
        max(abs(p['width']) for p in seen), min(max(left), 3.0),
        np.log(np.clip(np.sqrt(np.trace(fit.covariance) / len(fit.covariance)) / max(MEAN, MEAN_PX * step), 0.01, 100)),
        stops[tip], shown[tip], 0.0 if fit.open_end[tip] else tip_sigma, min(fit.aside[tip].max(), 2.0),
        fit.open_end.all(), np.log(count), (fit.alone >= 0).sum()], float)


def _plane(strips: Strips, v: int, half: float, radius_px: float, count: int) -> dict:
    """What plane `v` shows of a curve with `count` strips, and PAST more past either end."""
    x, profiles = strips.offsets_px, strips.profiles[v]
    flank = (np.abs(x) > half + 0.5) & (np.abs(x) <= 2 * half + 2)
    width = int(np.ceil(2 * half + 2))
    kernel = np.zeros(2 * width + 1, np.float32)
    inner = np.abs(np.arange(-width, width + 1)) <= half
    outer = (np.abs(np.arange(-width, width + 1)) > half + 0.5)
    kernel[inner], kernel[outer] = -1 / inner.sum(), 1 / outer.sum()
    dark = cv2.filter2D(profiles, cv2.CV_32F, kernel[None], borderType=cv2.BORDER_REPLICATE)
    number = count // BLOCK
    blocks = dark[PAST:PAST + number * BLOCK].reshape(number, BLOCK, -1).mean(axis=1)
    beside = blocks[:, (np.abs(x) > 2.5 * half + 2) & (np.abs(x) < x[-1] - width + 1)]
    spread = 1.4826 * middle(np.abs(beside - middle(beside.ravel())).ravel()) + 1e-12
    on = blocks[:, np.abs(x) <= 1].max(axis=1)
    usual = max(float(middle(on)), 1e-9)
    ratio = on / spread
    run = np.convolve(ratio, np.ones(3) / 3, 'valid') if number >= 3 else ratio
    mean = middle(profiles[PAST:PAST + count], axis=0)
    background = np.polyval(np.polyfit(x[flank], mean[flank], 2), x)
    near = np.abs(x) <= 2 * half + 2
    shadow = (background - mean)[near]
    even, odd = 0.5 * (shadow + shadow[::-1]), 0.5 * (shadow - shadow[::-1])
    positive = np.maximum(even, 0)
    # a cylinder's chords have a standard deviation of half its radius
    seen_width = np.sqrt((positive * x[near]**2).sum() / (positive.sum() + 1e-12)) / np.hypot(radius_px / 2, BLUR_PX)
    each = dark[:, np.abs(x) <= 1].max(axis=1) / usual
    ends = [(each[PAST:PAST + BLOCK].mean(), each[:PAST - 4].mean()), (each[PAST + count - BLOCK:PAST + count].mean(), each[PAST + count + 4:].mean())]
    odd_share = np.sqrt((odd**2).sum() / ((even**2).sum() + 1e-12))
    return dict(run=float(run.min()), share=float((ratio > CLEAR).mean()), odd=min(float(odd_share), 2.0), width=float(np.log(np.clip(seen_width, 0.3, 3.0))),
                stops=np.clip([i - o for i, o in ends], -1, 2), shown=np.clip([i for i, _ in ends], 0, 1.5))
