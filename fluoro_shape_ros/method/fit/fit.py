"""The 3-D spline fitted to both images at once.

Project the curve, cut strips across it in both images, see how far the device lies off in each, solve for the control
points, repeat. Residuals are perpendicular and sub-pixel, no correspondence is needed any more, and the normal
equations carry the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np

from ...geometry.cameras import depth, pixels_per_metre
from ...geometry.curve import arc_length, middle
from ...geometry.spline import Spline3, prolong, through
from ...imaging.profiles import background, own_shadow, shadow
from ...imaging.strips import (
    Measurement,
    Model,
    Sheet,
    Strips,
    clutter,
    cut,
    depth_across,
    half_width_range,
    measure,
    search,
)
from .bends import bent_on
from .ends import (
    ALONG_PX,
    BRIDGED_PX,
    GOES_ON,
    OUTWARD,
    PALEST,
    SMOOTH_PX,
    goes_on,
    supported,
    windows,
)
from .extent import extent
from .neighbours import without_neighbours
from .result import Fit, Rest
from .solver import Layout, solve

COARSE, FINE = 2, 6
MAX_HALF_WIDTH_PX = 400.0   # of anything that is looked for
LONGEST_PX = 16000      # OpenCV samples 32767 rows at once: the strips of both planes
COARSE_STEP = 3         # px between the strips of a coarse round
ASTRAY_PX = 1.0         # strips whose device lies farther off do not tell how far
FAINTER = 0.25          # share of a device's length that may be fainter than what windows are laid out for
HELPS = 0.7             # share of what averaging longer gains of white noise, that it at least must
AROUND_PX = 45          # along the curve, whose surroundings tell the noise
SETTLED_PX = 0.1        # a fine round that moves the curve less is the last: strips tell offsets so small exactly
WIDE_PX = 8.0           # extra reach of the strips while the start is still rough
EXTENSION_PX = 26.0     # how far beyond the presumed ends is looked at once
NEAR_END_PX = 8
ASTRAY = 0.04           # px a px, that it may bend away past an end
GROWTH_PX, GROWTH = 30, 8       # how far the curve is prolonged at once, and how often
GAP, LOOK_PX = 8e-3, 120        # m, and px at most: bands of a device lie less far apart, so one looks for it that far
                                # past its ends
GOES_ON_ALONE = 0.6     # darkness past an end in one plane alone, as a share of the usual, that makes one look farther
DARKEST = 1.3           # standard deviations that the darkest of half a dozen places is by noise


def fit(sheet: Sheet, points: np.ndarray, radius: float, coarse: int | None = COARSE, beyond_px: float = EXTENSION_PX,
        clearing: bool = False) -> Fit | None:
    """A Fit that starts at (N, 3) points in m, known to a few px; None where the images show no device there.

    radius: of the device, m. coarse: rounds that search for it a few px around; 0: one that measures where it is
    instead; None: none, and no Fit where it is not within ASTRAY_PX. beyond_px: how far past both ends is looked at
    once. clearing: take the line beside the device away, if there is one; slower.
    """
    views = sheet.views
    scale = [pixels_per_metre(v.P, points) for v in views]
    half_width, step = [radius * k for k in scale], 1 / max(scale)
    if max(half_width) > MAX_HALF_WIDTH_PX or min(depth(v.P, points).min() for v in views) <= 0:
        return None     # it goes to a source
    pair = _Pair.of(sheet, half_width, step, clearing)
    seen = pair.settle(through(points, beyond_px * step), (0.0, arc_length(points)[-1]), coarse, FINE)
    if seen is None:
        return None
    seen, farther = pair.grow(seen)
    found = extent(seen, pair.aside(seen), farther, partial(pair.look, seen.model), views, radius)
    nats, bent = bent_on(sheet, found.spline, (found.start, found.stop), step, pair.narrow, *seen.at_ends,
                         found.open_end, pair.look_px)
    return replace(found, farther=np.maximum(found.farther, nats), bent=bent)


@dataclass(frozen=True)
class _Surroundings:
    """What lies beside a curve, which tells what its darkness is worth."""

    s: np.ndarray           # (M,) m
    clutter: Callable[[np.ndarray], np.ndarray]     # (2, M) of (2,) px along them, see strips.clutter
    usual: np.ndarray       # (2, M) the same over SMOOTH_PX

    def along(self, s: np.ndarray, usual: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(2, N) how dark places happen to look in each plane at (N,) arc lengths, and (2,) px along which: so many
        that a device as dark as `usual` (2, N) stands out nearly everywhere `within` (N,)."""
        over = lambda clutter: np.stack([np.interp(s, self.s, c) for c in clutter])     # noqa: E731
        clear = np.nan_to_num(usual / over(self.usual))[:, within]
        px = windows(np.quantile(clear, FAINTER, axis=1)) if within.any() else ALONG_PX
        if (px == SMOOTH_PX).all():
            return over(self.usual), px
        longer = self.clutter(px)
        # anatomy looks alike over so many px, other than noise
        helps = np.median(self.usual / longer, axis=1) > HELPS * np.sqrt(px / SMOOTH_PX)
        return over(np.where(helps[:, None], longer, self.usual)), np.where(helps, px, SMOOTH_PX)


@dataclass(frozen=True)
class _Pair:
    """A pair of images, and what the device looks like in them."""

    sheet: Sheet
    step: float             # m, a px of the finer plane
    reach: float            # px to either side of the curve
    template: np.ndarray    # (2, W) a cylinder's shadow
    narrow: np.ndarray      # (2, w) the same, no wider than that
    cylinder: Model
    beside: list            # see profiles.background
    cleared: list | None    # px, the device's half width in each plane where the line beside it is taken away

    @classmethod
    def of(cls, sheet: Sheet, half_width: list[float], step: float, clearing: bool) -> _Pair:
        return cls(sheet, step, *_looks(*(round(100 * h) for h in half_width)), half_width if clearing else None)

    def settle(self, spline: Spline3, reference: tuple[float, float], coarse: int | None, fine: int,
               near: bool = False) -> Rest | None:
        """The curve brought to rest on the device, which lies between two arc lengths in m; None where there is
        none."""
        views = self.sheet.views
        if not spline.stop - spline.start < self.step * min(LONGEST_PX, sum(v.width + v.height for v in views)):
            return None     # it has left the images, or turns back and forth in them
        if coarse is not None:
            spline, reference = self._approach(spline, reference, coarse, near)
        layout = Layout.of(spline, self.step)
        around = self.surroundings(spline, reference)
        for k in range(fine):
            strips = self.cut(layout.basis @ spline.control, layout.slope @ spline.control)
            within = (layout.s >= reference[0]) & (layout.s <= reference[1])
            own = np.stack([own_shadow(p, b, within & i, e)
                            for p, b, i, e in zip(strips.profiles, self.beside, strips.inside, self.template)])
            model = Model.of(own, strips.offsets_px)
            measured = measure(strips, model, within)
            solution = solve(layout, spline, strips, measured, views, within)
            clutter, along = around.along(layout.s, measured.usual, within)
            stretch = supported(measured.presence.T, clutter / measured.usual, 1, self.gap_px, along)
            if stretch is None or (coarse is None and k == 0 and solution.moved_px > ASTRAY_PX):
                return None
            seen = Rest(layout, solution, strips, measured, within, model, clutter, along, stretch)
            spline, before, reference = solution.spline, reference, seen.reference
            if solution.moved_px < SETTLED_PX and np.abs(np.subtract(reference, before)).max() < 2 * self.step:
                break
        return seen

    def _approach(self, spline: Spline3, reference: tuple[float, float], coarse: int,
                  near: bool) -> tuple[Spline3, tuple[float, float]]:
        """The curve brought nearer to the device by so many rounds that search, or by one that measures, and between
        which arc lengths that lies, m."""
        views, layout = self.sheet.views, Layout.of(spline, COARSE_STEP * self.step)
        within = (layout.s >= reference[0]) & (layout.s <= reference[1])
        for _ in range(coarse):
            strips = cut(self.sheet, layout.basis @ spline.control, layout.slope @ spline.control, self.reach + WIDE_PX,
                         rough=True)
            spline = solve(layout, spline, strips, search(strips, self.template, smooth=3), views, within,
                           near=near).spline
        if coarse:
            return spline, reference
        strips = self.cut(layout.basis @ spline.control, layout.slope @ spline.control)
        measured = measure(strips, self.cylinder, within)
        clutter, along = self.surroundings(spline, reference).along(layout.s, measured.usual, within)
        stretch = supported(measured.presence.T, clutter / measured.usual, COARSE_STEP, self.gap_px, along)
        if stretch is not None:
            reference = (layout.s[stretch[0]], layout.s[stretch[1]])
        return solve(layout, spline, strips, measured, views, within).spline, reference

    @property
    def gap_px(self) -> float:
        """The longest stretch of the device that need not be seen."""
        return max(GAP / self.step, BRIDGED_PX)

    @property
    def look_px(self) -> int:
        """How far past its ends more of the device is looked for."""
        return min(round(GAP / self.step), LOOK_PX)

    def surroundings(self, spline: Spline3, reference: tuple[float, float]) -> _Surroundings:
        """What lies beside the curve between two arc lengths, m."""
        at = np.arange(*reference, COARSE_STEP * self.step)
        strips = cut(self.sheet, *spline.lines(at), 2 * self.reach + WIDE_PX, rough=True)

        def over(along_px: np.ndarray) -> np.ndarray:
            return clutter(strips, self.narrow, self.reach, along_px // COARSE_STEP, AROUND_PX // COARSE_STEP)

        return _Surroundings(at, over, over(ALONG_PX))

    def grow(self, seen: Rest) -> tuple[Rest, np.ndarray]:
        """The curve prolonged as long as that finds more of the device as it runs; (2,) what says that it goes on
        still, see `farther`."""
        coarse = int(self.cleared is None)     # a search would find the line beside the device again
        for _ in range(GROWTH):
            farther, nats = self.farther(seen)
            more = seen.known_beyond & ((nats > GOES_ON) | (seen.beyond > GOES_ON_ALONE).any(axis=1))
            if not more.any():
                return seen, nats
            by = max(GROWTH_PX, farther[nats > GOES_ON].max(initial=0) + NEAR_END_PX) * self.step
            (start, stop), (spline, shift) = seen.reference, prolong(seen.solution.spline, more, by)
            longer = self.settle(spline, (start + shift - more[0] * by, stop + shift + more[1] * by), coarse,
                                 FINE - 1, near=True)
            if longer is None or np.ptp(longer.reference) < stop - start:
                break
            seen = longer
            if np.ptp(longer.reference) - (stop - start) < NEAR_END_PX * self.step:
                break
        return seen, self.farther(seen)[1]

    def farther(self, seen: Rest) -> tuple[np.ndarray, np.ndarray]:
        """(2,) px by which the device may go on past the first and the last end, straight on, perhaps beyond a gap; and
        (2,) nats that speak for that."""
        px = np.arange(1, self.look_px, COARSE_STEP)
        s = np.array(seen.reference)[:, None] + OUTWARD[:, None] * (px + SMOOTH_PX) * self.step
        strips = cut(self.sheet, *seen.solution.spline.lines(s.ravel()), self.reach + WIDE_PX, rough=True).halves()
        dark = np.array([cv2.blur(depth_across(p, t), (1, SMOOTH_PX // COARSE_STEP), borderType=cv2.BORDER_REPLICATE)
                         for p, t in zip(strips.profiles, self.narrow.repeat(2, axis=0))])
        straight = np.abs(strips.offsets_px) <= 1 + px[:, None] * ASTRAY        # it need not go on quite straight
        # (planes, ends, places)
        dark = np.where(strips.inside, np.where(straight, dark, -np.inf).max(axis=2), 0.0).reshape(2, 2, -1)
        usual, clutter = (x.T[..., None] for x in seen.at_ends)
        clutter = np.maximum(clutter, PALEST * usual)
        nats = goes_on(dark / clutter, usual / clutter, np.full(dark.shape, COARSE_STEP), straight.sum(axis=1).max())
        return px[nats.argmax(axis=1)], np.nan_to_num(np.maximum(nats.max(axis=1), 0.0))

    def aside(self, seen: Rest) -> np.ndarray:
        """(2, 2) darkness, as a share of the device's, of a line within WIDE_PX of where each end (rows) would go on,
        in plane A, B, beyond what noise has there."""
        px = np.arange(-80, 20)
        s = (np.array(seen.reference)[:, None] + OUTWARD[:, None] * px * self.step).ravel()
        strips = cut(self.sheet, *seen.solution.spline.lines(s), self.reach + WIDE_PX, rough=True).halves()
        line = search(strips, self.template.repeat(2, axis=0))
        usual, clutter = (x.T.ravel() for x in seen.at_ends)
        noise = DARKEST * np.nan_to_num(clutter / usual, nan=np.inf)
        return np.maximum(middle(line.presence[:, (px > 6) & (px < 18)]) - noise, 0).reshape(2, 2).T

    def cut(self, points: np.ndarray, tangents: np.ndarray) -> Strips:
        """Strips across the projections of (N, 3) points with (N, 3) tangents."""
        if self.cleared is None:
            return cut(self.sheet, points, tangents, self.reach)
        return without_neighbours(cut(self.sheet, points, tangents, self.reach + WIDE_PX), self.cleared, self.reach)

    def look(self, model: Model, f: Fit, s: np.ndarray, within: np.ndarray) -> tuple[Strips, Measurement]:
        """Strips across a fit at (N,) arc lengths, and what they say of a device of this `model`; or at (2, N / 2), by
        the ends: see Strips.halves."""
        strips = self.cut(*f.spline.lines(s.ravel()))
        if s.ndim == 2:
            strips, model, within = strips.halves(), model.twice(), np.concatenate([within, within])
        return strips, measure(strips, model, within)


@lru_cache(64)
def _looks(*half_width_cpx: int) -> tuple[float, np.ndarray, np.ndarray, Model, list[np.ndarray]]:
    """How far strips reach, the shadow of a cylinder of so many hundredths of a px in each plane, and what a _Pair
    makes of it."""
    reach = half_width_range(max(half_width_cpx) / 100)
    offsets = np.arange(-reach, reach + 1)
    template = np.stack([shadow(h / 100, offsets) for h in half_width_cpx])
    narrow = template[:, np.abs(offsets) <= 1.6 * max(half_width_cpx) / 100 + 3]
    return reach, template, narrow, Model.of(template, offsets), [background(t, offsets) for t in template]
