"""The 3-D spline fitted to both images at once.

Project the curve, cut strips across it in both images, see how far the device lies off in each, solve for the control
points, repeat. Residuals are perpendicular and sub-pixel, no correspondence is needed any more, and the normal
equations carry the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from ...data import View
from ...geometry.cameras import depth, pixels_per_metre, projection_jacobian, slant
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
from .ends import BLURS_PX, BRIDGED_PX, GOES_ON, SMOOTH_PX, End, evidence, level, locate, past_band, supported
from .neighbours import without_neighbours
from .opacity import bulge, exponent, rim
from .solver import Layout, Solution, solve

COARSE, FINE = 2, 6
MAX_HALF_WIDTH_PX = 400.0   # of anything that is looked for
LONGEST_PX = 16000      # OpenCV samples 32767 rows at once: the strips of both planes
COARSE_STEP = 3         # px between the strips of a coarse round
ASTRAY_PX = 1.0         # strips whose device lies farther off do not tell how far
AROUND_PX = 45          # along the curve, whose surroundings tell the noise
SETTLED_PX = 0.1        # a fine round that moves the curve less is the last: strips tell offsets so small exactly
WIDE_PX = 8.0           # extra reach of the strips while the start is still rough
EXTENSION_PX = 26.0     # how far beyond the presumed ends is looked at once
NEAR_END_PX = 8
ASTRAY = 0.04           # px a px, that it may bend away past an end
GROWTH_PX, GROWTH = 30, 8       # how far the curve is prolonged at once, and how often
# strips around an end, and how far from the first guess it is looked for
END_WINDOW_PX, END_STEP_PX, END_REACH_PX = 16.0, 0.5, 2.0
AGREE = 1.5             # standard deviations by which the planes' ends differ at most, that tell the depth of a curve
BESIDE = 5.0            # ... which itself knows it to so many of them at least
OUTWARD = np.array([-1, 1])     # from the first end, from the last
GAP, LOOK_PX = 8e-3, 120        # m, and px at most: bands of a device lie less far apart, so one looks for it that far
                                # past its ends
GOES_ON_ALONE = 0.6     # darkness past an end in one plane alone, as a share of the usual, that makes one look farther
BARE, HIDES = 0.25, 0.7         # darkness past an end or aside, in a plane that shows it well, and in one where another
                                # line may hide it ...
CROSSES = 0.5           # ... that goes across, so that straight on it is less dark
CROWDED = 0.4           # darkness aside in both planes, that makes an end hard to see
HARD_PX = 1.0           # what an end is worth that only one plane shows, or that is hard to see in both


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
    power: float                # 1: translucent, 0: opaque, see opacity.exponent
    beyond: np.ndarray          # (2, 2) darkness just past the first and the last end (rows) in plane A, B, as a share
                                # of the device's
    aside: np.ndarray           # (2, 2) the same of a line beside where each end would go on
    farther: np.ndarray         # (2,) nats by which both planes show it going on past each end, straight on or bent
    alone: np.ndarray           # (2,) the plane that alone tells where each end is, because a line hides it in the
                                # other; -1: both tell
    moved_px: float             # how far the last step of the solver moved it, at most: a fit that still moves has not
                                # come to rest
    seen_at: np.ndarray | None = None       # (2, 2) m, where the first and the last end (rows) are by plane A, B alone;
                                            # NaN where one does not tell well
    seen_sigma: np.ndarray | None = None    # (2, 2) m
    bent: np.ndarray | None = None          # (N, 3) m, the curve going on in a bend past an end, where both planes show
                                            # something there

    def curve(self, count: int) -> np.ndarray:
        """(count, 3) m along the device."""
        return self.spline(np.linspace(self.start, self.stop, count))


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
    found, ends = _finish(seen, pair.aside(seen), farther, views, radius)
    found = replace(found, covariance=_confirmed(found, ends, views))
    found = _see_ends(partial(pair.look, seen.model), found, ends, views, radius, *seen.at_ends)
    nats, bent = bent_on(sheet, found.spline, (found.start, found.stop), step, pair.narrow, *seen.at_ends,
                         found.open_end, pair.look_px)
    return replace(found, farther=np.maximum(found.farther, nats), bent=bent)


@dataclass(frozen=True)
class _Seen:
    """A curve that has come to rest, and what the strips across it say."""

    layout: Layout
    solution: Solution
    strips: Strips
    measured: Measurement
    within: np.ndarray              # (N,) bool: the strips that counted
    model: Model
    clutter: np.ndarray             # (2, N) see strips.clutter
    stretch: tuple[int, int]        # first and last strip of the device

    @property
    def reference(self) -> tuple[float, float]:
        """m, where the device begins and where it ends."""
        return self.layout.s[self.stretch[0]], self.layout.s[self.stretch[1]]

    @property
    def at_ends(self) -> tuple[np.ndarray, np.ndarray]:
        """(2, 2) `usual` darkness, and `clutter`, at the first and the last end (rows) in each plane."""
        ends = list(self.stretch)
        return self.measured.usual[:, ends].T, self.clutter[:, ends].T

    @property
    def beyond(self) -> np.ndarray:
        """(2, 2) darkness past the first and the last end (rows) in each plane, see _beyond."""
        presence = self.measured.presence.T
        return np.stack([_beyond(presence, self.stretch[0], -1), _beyond(presence, self.stretch[1], 1)])

    @property
    def known_beyond(self) -> np.ndarray:
        """(2,) bool: whether both planes' fields reach past the first and the last end."""
        return ~np.isnan(self.beyond).any(axis=1)


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
               near: bool = False) -> _Seen | None:
        """The curve brought to rest on the device, which lies between two arc lengths in m; None where there is
        none."""
        views = self.sheet.views
        if not spline.stop - spline.start < self.step * min(LONGEST_PX, sum(v.width + v.height for v in views)):
            return None     # it has left the images, or turns back and forth in them
        if coarse is not None:
            spline, reference = self._approach(spline, reference, coarse, near)
        layout = Layout.of(spline, self.step)
        clutter = self.clutter(spline, reference, layout.s)
        for k in range(fine):
            strips = self.cut(layout.basis @ spline.control, layout.slope @ spline.control)
            within = (layout.s >= reference[0]) & (layout.s <= reference[1])
            own = np.stack([own_shadow(p, b, within & i, e)
                            for p, b, i, e in zip(strips.profiles, self.beside, strips.inside, self.template)])
            model = Model.of(own, strips.offsets_px)
            measured = measure(strips, model, within)
            solution = solve(layout, spline, strips, measured, views, within)
            stretch = supported(measured.presence.T, clutter / measured.usual, gap_px=self.gap_px)
            if stretch is None or (coarse is None and k == 0 and solution.moved_px > ASTRAY_PX):
                return None
            seen = _Seen(layout, solution, strips, measured, within, model, clutter, stretch)
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
        stretch = supported(measured.presence.T, self.clutter(spline, reference, layout.s) / measured.usual,
                            COARSE_STEP, self.gap_px)
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

    def clutter(self, spline: Spline3, reference: tuple[float, float], s: np.ndarray) -> np.ndarray:
        """(2, N) how dark places beside the curve between two arc lengths (m) happen to look in each plane, at (N,) arc
        lengths, see strips.clutter."""
        at = np.arange(*reference, COARSE_STEP * self.step)
        strips = cut(self.sheet, *spline.lines(at), 2 * self.reach + WIDE_PX, rough=True)
        seen = clutter(strips, self.narrow, self.reach, SMOOTH_PX // COARSE_STEP, AROUND_PX // COARSE_STEP)
        return np.stack([np.interp(s, at, c) for c in seen])

    def grow(self, seen: _Seen) -> tuple[_Seen, np.ndarray]:
        """The curve prolonged as long as that finds more of the device as it runs; (2,) what says that it goes on
        still, see `farther`."""
        coarse = int(self.cleared is None)     # a search would find the line beside the device again
        for _ in range(GROWTH):
            farther, nats = self.farther(seen)
            goes_on = seen.known_beyond & ((nats > GOES_ON) | (seen.beyond > GOES_ON_ALONE).any(axis=1))
            if not goes_on.any():
                return seen, nats
            by = max(GROWTH_PX, farther[nats > GOES_ON].max(initial=0) + NEAR_END_PX) * self.step
            (start, stop), (spline, shift) = seen.reference, prolong(seen.solution.spline, goes_on, by)
            longer = self.settle(spline, (start + shift - goes_on[0] * by, stop + shift + goes_on[1] * by), coarse,
                                 FINE - 1, near=True)
            if longer is None or np.ptp(longer.reference) < stop - start:
                break
            seen = longer
            if np.ptp(longer.reference) - (stop - start) < NEAR_END_PX * self.step:
                break
        return seen, self.farther(seen)[1]

    def farther(self, seen: _Seen) -> tuple[np.ndarray, np.ndarray]:
        """(2,) px by which the device may go on past the first and the last end, straight on, perhaps beyond a gap; and
        (2,) nats that speak for that."""
        px = np.arange(1, self.look_px, COARSE_STEP)
        s = np.array(seen.reference)[:, None] + OUTWARD[:, None] * (px + SMOOTH_PX) * self.step
        strips = cut(self.sheet, *seen.solution.spline.lines(s.ravel()), self.reach + WIDE_PX, rough=True)
        far, nats, usual, beside = np.zeros(2), np.zeros(2), *seen.at_ends
        for k in (0, 1):
            mine = slice(k * len(px), (k + 1) * len(px))
            straight = np.abs(strips.offsets_px) <= 1 + px[:, None] * ASTRAY     # it need not go on quite straight
            dark = [np.where(straight, depth_across(p[mine], t), -np.inf).max(axis=1)
                    for p, t in zip(strips.profiles, self.narrow)]
            total = np.cumsum(evidence(np.where(strips.inside[:, mine], dark, np.nan) / usual[k][:, None],
                                       (beside[k] / usual[k])[:, None], COARSE_STEP))
            best = int(total.argmax())
            far[k], nats[k] = px[best], max(float(total[best]), 0.0)
        return far, nats

    def aside(self, seen: _Seen) -> np.ndarray:
        """(2, 2) darkness, as a share of the device's, of a line within WIDE_PX of where each end (rows) would go on,
        in plane A, B."""
        px = np.arange(-80, 20)
        s = (np.array(seen.reference)[:, None] + OUTWARD[:, None] * px * self.step).ravel()
        strips = cut(self.sheet, *seen.solution.spline.lines(s), self.reach + WIDE_PX, rough=True).halves()
        line = search(strips, self.template.repeat(2, axis=0))
        return middle(line.presence[:, (px > 6) & (px < 18)]).reshape(2, 2).T

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


def _beyond(presence: np.ndarray, at: int, outward: int) -> np.ndarray:
    """(2,) darkness that each plane shows just past strip `at`, as a share of the device's; NaN outside its field, 1
    where the strips end before it does."""
    past = presence[at + 5:at + 22] if outward > 0 else presence[max(at - 21, 0):max(at - 4, 0)]
    if len(past) < 10:
        return np.where(np.isnan(past).any(axis=0), np.nan, 1.0)
    return np.where(np.isnan(past).any(axis=0), np.nan, middle(past, axis=0))


def _finish(found: _Seen, aside: np.ndarray, farther: np.ndarray, views: Sequence[View],
            radius: float) -> tuple[Fit, list[End | None]]:
    """The fit, and its ends where they are seen."""
    s, strips, seen, reference, solution = found.layout.s, found.strips, found.measured, found.reference, found.solution
    presence, inside, lit = seen.presence.T, strips.inside.T, strips.lit.all(axis=0)
    between = (s > reference[0]) & (s < reference[1])
    at = np.minimum(np.searchsorted(s, reference), len(s) - 1)
    # it runs out of a field before its end
    open_end = np.array([not inside[max(at[0] - 14, 0):at[0] + 1].all(), not inside[at[1]:at[1] + 14].all()])
    twice = lambda x: np.broadcast_to(x, (2, *x.shape))     # noqa: E731
    inward = OUTWARD[:, None] * (np.array(reference)[:, None] - s)
    height, inner = _levels(twice(seen.presence), inward, s[1] - s[0])
    usual, beside = found.at_ends
    sine = _slants(solution.spline, s, views)
    power = exponent(seen.presence * seen.usual, sine, inside.T & between)
    noise = np.maximum(seen.presence_sigma, np.sqrt(SMOOTH_PX) * beside / np.nan_to_num(usual, nan=1e-9))
    located = locate(twice(s), twice(seen.presence) / height[..., None], noise / height, twice(strips.speed),
                     np.array(reference), OUTWARD, bulge(radius, sine[:, at].T, power),
                     rim(radius, sine[:, at].T), blurs_px=BLURS_PX[1:2], inner=inner)
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


def _levels(presence: np.ndarray, inward: np.ndarray, px: float) -> tuple[np.ndarray, np.ndarray]:
    """(2, 2) and (2,) of ends.level for both ends (rows): of (2, 2, N) presence, at (2, N) arc lengths inside them,
    m."""
    height, inner = zip(*(level(p, i, px) for p, i in zip(presence, inward)))
    return np.array(height), np.array(inner)


def _confirmed(f: Fit, ends: Sequence[End | None], views: Sequence[View]) -> np.ndarray:
    """(3 n, 3 n) covariance of a fit whose ends both planes see at one place, as far as they see it: a curve that runs
    in an epipolar plane is seen across itself by neither, but its ends tell its depth. Where they differ by more, one
    of them may be another edge, which tells nothing; where the curve itself hardly knows its depth, that they do not
    may be chance: a faint edge is known less well than it seems.

    Moved by dX at its end, plane v sees that end at s_v - t_v J_v dX / |J_v X'|, t_v along the projected curve.
    """
    covariance = f.covariance
    for end, by in zip(ends, _shown_by_one(f)):
        if end is None or by >= 0 or not end.apart < AGREE * np.hypot(*end.seen_sigma):
            continue
        (basis,), (slope,) = f.spline.bases(np.array([end.at]), 0, 1)
        X, T = basis @ f.spline.control, slope @ f.spline.control
        a, b = ((J @ T) @ J / max((J @ T) @ (J @ T), 1e-9) for J in (projection_jacobian(v.P, X) for v in views))
        row, variance = (basis[:, None] * (a - b)).ravel(), float(end.seen_sigma @ end.seen_sigma)
        told = covariance @ row
        if row @ told < BESIDE**2 * variance:
            covariance = covariance - np.outer(told, told) / (row @ told + variance)    # Kalman 1960
    return covariance


def _slants(spline: Spline3, s: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """(V, N) sine of the angle at which each plane sees a curve at (N,) arc lengths."""
    points, tangents = spline.lines(s)
    return np.stack([slant(v.P, points, tangents) for v in views])


def _see_ends(look: Callable, f: Fit, ends: list[End | None], views: Sequence[View], radius: float,
              usual: np.ndarray, clutter: np.ndarray) -> Fit:
    """The fit with its ends seen once more, by strips laid out from where they are: where strips happen to lie must not
    count. usual, clutter: (2, 2) at each end (rows) in each plane, see _Seen."""
    step, by = f.s[1] - f.s[0], _shown_by_one(f)
    alone = np.array([v if end is not None and v >= 0 and np.isfinite(end.seen_at[v]) and end.disagreed else -1
                      for end, v in zip(ends, by)])
    at = np.array([x if end is None or v < 0 else end.seen_at[v] for end, v, x in zip(ends, alone, (f.start, f.stop))])
    window = np.arange(-END_WINDOW_PX, END_WINDOW_PX + END_STEP_PX, END_STEP_PX) * step
    s = at[:, None] + window
    strips, seen = look(f, s, OUTWARD[:, None] * window < 0)
    # (ends, planes, strips)
    presence, speed = (x.reshape(2, 2, -1).transpose(1, 0, 2) for x in (seen.presence, strips.speed))
    height, inner = _levels(presence, -OUTWARD[:, None] * window, step)
    sine = _slants(f.spline, at, views).T
    # (ends, planes)
    noise = np.sqrt(SMOOTH_PX) * clutter / np.nan_to_num(middle(seen.usual), nan=1e-9).reshape(2, 2).T
    again = locate(s, presence / height[..., None], np.maximum(seen.presence_sigma.reshape(2, 2).T, noise) / height,
                   speed, at, OUTWARD, bulge(radius, sine, f.power), rim(radius, sine), density=1 / END_STEP_PX,
                   reach_px=END_REACH_PX, inner=inner)
    guess, hard, sigma = at.copy(), crowded(f), np.zeros(2)
    for k, (end, v) in enumerate(zip(ends, alone)):
        if v >= 0 and np.isfinite(again[k].seen_at[v]):
            at[k], sigma[k], hard[k] = again[k].seen_at[v], again[k].seen_sigma[v], True
        elif end is not None:
            at[k], sigma[k] = again[k].at, replace(end, sigma=end.sigma if end.sigma > END_REACH_PX * step
                                                              else again[k].sigma).honest_sigma
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
