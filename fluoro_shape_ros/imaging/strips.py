"""The image seen from along the curve: strips across it, and what they say about where it lies and where it ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..data import View
from ..geometry.cameras import distort
from ..geometry.curve import middle
from .parallel import both

TOGETHER = 25           # strips along which a structured background errs the same way
MISFIT = 1.25           # mean square of a strip's rest, in noise variances, that noise alone rarely exceeds over
                        # TOGETHER strips
PALER, DARKER = 0.15, 4.0       # times as dark as it usually is, that a part of a device may be
MIDDLE_THIRD = 0.6825   # mean of the middle third of the absolute values of a standard normal variable
SURELY = 3.0            # standard deviations by which a strip that is darker than usual is so not by noise
PALE = 0.4              # times as dark as usual, that the line found in a strip at least is
FOUND_PX = 0.3          # what `search` is worth
MARGIN_PX = 4           # of a Sheet: interpolation reaches 2 px
SMOOTHED = 4            # px to either side, over which a line seen pixel by pixel is smoothed


@dataclass(frozen=True)
class Strips:
    """Profiles across a curve: in each of V planes (leading axis), or in one image (no leading axis)."""

    centers_px: np.ndarray  # (V, N, 2) undistorted pixels
    normals: np.ndarray     # (V, N, 2) unit, across the curve
    speed: np.ndarray       # (V, N) px per m of arc length: foreshortening shows here
    profiles: np.ndarray    # (V, N, W) image values at offsets
    offsets_px: np.ndarray  # (W,)
    inside: np.ndarray      # (V, N) bool: the whole strip lies in the exposed field
    lit: np.ndarray         # (V, N) bool: its middle does

    def halves(self) -> Strips:
        """Both halves of the N strips as if planes of their own showed them: (2 V, N / 2), both of plane A, both of
        plane B."""
        half = (2 * len(self.speed), -1)
        return Strips(*(a.reshape(*half, *a.shape[2:])    # type: ignore[call-arg]
                        for a in (self.centers_px, self.normals, self.speed, self.profiles)), self.offsets_px,
                      self.inside.reshape(half), self.lit.reshape(half))


@dataclass(frozen=True)
class Measurement:
    """What each strip says."""

    offset_px: np.ndarray       # (V, N) of the device's centre along the normal
    variance: np.ndarray        # (V, N) of it, px^2
    presence: np.ndarray        # (V, N) 1: as dark as the device usually is, 0: nothing there
    presence_sigma: np.ndarray  # (V,) standard deviation of `presence` from noise
    noise: np.ndarray           # (V,) standard deviation of a sample
    usual: np.ndarray           # (V, N) darkness, in image values, that `presence` is a share of


def half_width_range(half_width_px: float) -> float:
    """How far a strip reaches to either side, px: the blurred device and some background."""
    return float(np.ceil(1.6 * half_width_px + 5.0))


@dataclass(frozen=True)
class Sheet:
    """The images of V planes one below the other, so that one call samples all of them."""

    image: np.ndarray       # (H, W) float32
    field: np.ndarray       # (H, W) uint8
    top: np.ndarray         # (V, 1, 1) float32, row where each plane begins
    heights: np.ndarray     # (V, 1, 1) float32
    planes: Sequence[np.ndarray]    # V (H, W) float32, parts of `image`
    fields: Sequence[np.ndarray]    # V (H, W) uint8
    views: Sequence[View]

    @classmethod
    def of(cls, images: Sequence, fields: Sequence[np.ndarray], views: Sequence[View],
           draw: Callable[..., None] = lambda image, out: np.copyto(out, image)) -> Sheet:
        """From V images (of a dark device) and their (H, W) uint8 fields; `draw` writes one to an (H, W) float32 array.

        Around each lie MARGIN_PX rows of its own border, exposed nowhere.
        """
        heights, width = np.array([len(f) for f in fields]), max(f.shape[1] for f in fields)
        top = np.cumsum(heights + 2 * MARGIN_PX) - heights - MARGIN_PX
        whole = np.empty((top[-1] + heights[-1] + MARGIN_PX, width), np.float32)
        exposed = np.zeros(whole.shape, np.uint8)
        planes = [whole[t:t + len(f), :f.shape[1]] for t, f in zip(top, fields)]
        both(draw, images, planes, pixels=whole.size)
        for t, plane, f in zip(top, planes, fields):
            h, w = f.shape
            exposed[t:t + h, :w] = f
            whole[t:t + h, w:] = plane[:, -1:]
            whole[t - MARGIN_PX:t], whole[t + h:t + h + MARGIN_PX] = whole[t], whole[t + h - 1]
        column = lambda x: x[:, None, None].astype(np.float32)      # noqa: E731
        return cls(whole, exposed, column(top), column(heights), planes, fields, views)

    def places(self, centers: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(V, N, W) float32 column and row of the samples of N strips at (W,) offsets."""
        u, v = places(centers, normals, offsets)
        for k, view in enumerate(self.views):
            if view.distortion is not None:
                u[k], v[k] = _distorted(view, u[k], v[k], offsets)
        # into the margin: what lies outside a plane looks like its border
        np.minimum(np.maximum(v, -2, out=v), self.heights + 1, out=v)
        v += self.top
        return u, v

    def sample(self, u: np.ndarray, v: np.ndarray, interpolation: int) -> np.ndarray:
        """(V, N, W) image values there."""
        return _remap(self.image, u, v, interpolation, cv2.BORDER_REPLICATE)

    def exposed(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(V, N, W) bool: whether they lie in the field."""
        return _remap(self.field, u, v, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0


def _distorted(view: View, u: np.ndarray, v: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, W) places on strips after distortion, which over a strip is a parabola: known at three of its (W,) offsets,
    which are symmetric."""
    x, at = offsets / offsets[-1], [0, len(offsets) // 2, -1]
    known = distort(view, np.stack([u[:, at], v[:, at]], axis=2).reshape(-1, 2)).reshape(-1, 3, 2).astype(np.float32)
    parabola = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2]).astype(np.float32)
    return known[..., 0] @ parabola, known[..., 1] @ parabola


def _remap(image: np.ndarray, u: np.ndarray, v: np.ndarray, interpolation: int, border: int) -> np.ndarray:
    flat = -1, u.shape[-1]
    return cv2.remap(image, u.reshape(flat), v.reshape(flat), interpolation, borderMode=border,
                     borderValue=0).reshape(u.shape)


def cut(sheet: Sheet, points: np.ndarray, tangents: np.ndarray, reach_px: float, rough: bool = False) -> Strips:
    """Strips across the projections of (N, 3) points with (N, 3) tangents dX/ds, one a point and plane.

    rough: interpolated linearly, several times as fast; for what is looked for to a pixel.
    """
    return cut_at(sheet, *lay_out(sheet.views, points, tangents), reach_px, rough)


def cut_at(sheet: Sheet, centers: np.ndarray, normals: np.ndarray, speed: np.ndarray, reach_px: float,
           rough: bool = False) -> Strips:
    """Strips as `lay_out` has them."""
    offsets = np.arange(-reach_px, reach_px + 1)
    u, v = sheet.places(centers, normals, offsets)
    ends = [0, len(offsets) // 2, -1]
    exposed = sheet.exposed(u[..., ends], v[..., ends])
    profiles = sheet.sample(u, v, cv2.INTER_LINEAR if rough else cv2.INTER_CUBIC)
    return Strips(centers, normals, speed, profiles, offsets, exposed.all(axis=2), exposed[..., 1])


def lay_out(views: Sequence[View], points: np.ndarray,
            tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, normals and speed of the strips across the projections of (N, 3) points with (N, 3) tangents dX/ds, see
    Strips."""
    P = np.stack([v.P for v in views])
    x = points @ P[:, :, :3].transpose(0, 2, 1) + P[:, None, :, 3]
    centers = x[..., :2] / x[..., 2:]
    dx = tangents @ P[:, :, :3].transpose(0, 2, 1)
    step = (dx[..., :2] - centers * dx[..., 2:]) / x[..., 2:]
    speed = np.hypot(step[..., 0], step[..., 1])
    normals = np.empty_like(step)
    np.divide(-step[..., 1], np.maximum(speed, 1e-9), out=normals[..., 0])
    np.divide(step[..., 0], np.maximum(speed, 1e-9), out=normals[..., 1])
    return centers, normals, speed


def places(centers: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(..., N, W) float32 u and v of the samples of (..., N, 2) strips at (W,) offsets."""
    centers, normals, offsets = (x.astype(np.float32) for x in (centers, normals, offsets))
    return (centers[..., 0, None] + normals[..., 0, None] * offsets,
            centers[..., 1, None] + normals[..., 1, None] * offsets)


def cut_along(image: np.ndarray, field: np.ndarray, lines_px: list[np.ndarray],
              reach_px: float) -> tuple[Strips, np.ndarray]:
    """Strips across (N, 2) lines of image pixels about a pixel apart, at every third;
    and of which line each strip is."""
    lengths = np.array([len(line) for line in lines_px])
    last = np.cumsum(lengths) - 1
    at, of = (np.concatenate(x) for x in zip(*((np.arange(stop - n + 1, stop + 1, 3), np.full(-(-n // 3), k))
                                               for k, (n, stop) in enumerate(zip(lengths, last)))))
    points = np.concatenate(lines_px)
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(points, axis=0)])
    low, high = np.maximum(at - SMOOTHED, (last - lengths + 1)[of]), np.minimum(at + SMOOTHED, last[of])
    centers = (total[high + 1] - total[low]) / (high + 1 - low)[:, None]
    along = ((total[high + 1] - total[at]) / (high + 1 - at)[:, None]
             - (total[at + 1] - total[low]) / (at + 1 - low)[:, None])     # from the mean behind to that ahead
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / (np.hypot(along[:, 0], along[:, 1]) + 1e-9)[:, None]
    offsets = np.arange(-reach_px, reach_px + 1)
    u, v = places(centers, normals, offsets)
    ends = [0, len(offsets) // 2, -1]
    exposed = _remap(field, u[:, ends], v[:, ends], cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0
    profiles = _remap(image, u, v, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
    return Strips(centers, normals, np.ones(len(centers)), profiles, offsets, exposed.all(axis=1), exposed[:, 1]), of


@dataclass(frozen=True)
class Model:
    """What a strip is made of: I = b0 + b1 x + b2 x^2 - c (T(x) - d T'(x)), background, darkness and shift of the
    device's profile T."""

    parts: np.ndarray       # (V, W, 5)
    solve: np.ndarray       # (V, 5, W) what gives the amount of each by least squares

    @classmethod
    def of(cls, shadows: np.ndarray, offsets_px: np.ndarray) -> Model:
        """From the (V, W) profiles."""
        x = offsets_px / offsets_px[-1]
        M = np.zeros((*shadows.shape, 5))
        M[..., 0], M[..., 1], M[..., 2], M[..., 3] = 1, x, x * x, shadows
        M[:, 1:-1, 4] = 0.5 * (shadows[:, 2:] - shadows[:, :-2])
        T = M.transpose(0, 2, 1)
        return cls(M, np.linalg.solve(T @ M, T))

    def twice(self) -> Model:
        """For Strips.halves."""
        return Model(self.parts.repeat(2, axis=0), self.solve.repeat(2, axis=0))


def measure(strips: Strips, model: Model, reference: np.ndarray | None = None) -> Measurement:
    """Least squares of each strip for what its plane's `model` says it is made of.

    `reference` (N,) or (V, N) bool: the strips whose darkness counts as usual; all by default.
    """
    width = len(strips.offsets_px)
    M, fit = model.parts, model.solve
    coefficients = strips.profiles @ fit.transpose(0, 2, 1)
    rest = strips.profiles - coefficients @ M.transpose(0, 2, 1)
    noise = (1.4826 * np.sqrt(width / (width - 5)) * middle(np.abs(rest[:, ::2]).reshape(len(rest), -1))
             + 1e-9)[:, None]
    inside = strips.inside
    darkness = np.where(inside, -coefficients[..., 3], np.nan)
    usual = np.stack([_running_median(d, i)
                      for d, i in zip(darkness, inside if reference is None else inside & reference)])
    usual[~(usual > 1e-9)] = np.nan     # no darkness at all, or brighter than its surroundings: no device to measure
    gain = np.sqrt((fit * fit).sum(axis=2))
    # a band is by far darker than the rest: what surely is darker than usual counts as it is
    dark = usual * np.fmax((darkness - SURELY * noise * gain[:, 3:4]) / usual, 1.0)
    offset = coefficients[..., 4] / dark
    variance = (noise * gain[:, 4:]) ** 2 / (usual * dark)   # it may be another line's, too
    # A background that is no parabola pulls neighbouring strips the same way: there their errors do not average out.
    square = rest * rest
    limit = 9 * noise**2
    misfit = cv2.blur(np.minimum(np.einsum('vnw->vn', square) / (width - 5), limit), (TOGETHER, 1),
                      borderType=cv2.BORDER_REFLECT) / noise**2
    variance *= 1 + TOGETHER * np.maximum(misfit - MISFIT, 0)
    # another edge runs through: not to be trusted
    odd = np.einsum('vnw->vn', np.minimum(square, limit[..., None])) > 3.5 * width * noise**2
    variance[~inside | odd | np.isnan(variance)] = np.inf
    sigma = np.array([n * g / middle(u) if np.isfinite(u[0]) else np.inf
                      for n, g, u in zip(noise[:, 0], gain[:, 3], usual)])
    offset[np.isnan(offset)] = 0.0
    return Measurement(offset, variance, darkness / usual, sigma, noise[:, 0], usual)


def darkness_across(profiles: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    """(N, W) how dark a line with this (w,) shadow is at each place of (N, W) float32 profiles: a matched filter."""
    return -cv2.filter2D(profiles, cv2.CV_32F, (shadow - shadow.mean())[None].astype(np.float32),
                         borderType=cv2.BORDER_REPLICATE)


def depth_across(profiles: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    """The same as the depth in image values of a line with this shadow of unit depth."""
    centred = shadow - shadow.mean()
    return darkness_across(profiles, shadow) / (centred @ centred)


def depths(shadow: np.ndarray, places: int) -> np.ndarray:
    """(w + places - 1, places) float32 what gives, of profiles so wide, the `depth_across` at their middle places."""
    centred = shadow - shadow.mean()
    each = np.zeros((places, len(shadow) + places), np.float32)
    each[:, :len(shadow)] = -centred / (centred @ centred)
    return each.ravel()[:-places].reshape(places, -1).T     # each row one place farther


def clutter(strips: Strips, shadows: np.ndarray, beside_px: float, along: np.ndarray,
            around: int) -> np.ndarray:
    """(V, N) how dark places farther than `beside_px` from the middle of the strips happen to look around each strip,
    in image values: the spread (see `local_spread`) of what a line with the (V, w) `shadows` of unit depth seems to be
    there, averaged over `along` (V,) strips; those of `around` strips, or of three such stretches, count."""
    spread = np.empty(strips.inside.shape)
    for v, (profiles, shape, n) in enumerate(zip(strips.profiles, shadows, along)):
        at = np.arange(min(n // 2, len(profiles) - 1), len(profiles), n)
        dark = cv2.blur(depth_across(profiles, shape), (1, int(n)))[at]
        x, half = strips.offsets_px, len(shape) // 2
        beside = dark[:, (np.abs(x) > beside_px) & (np.abs(x) < x[-1] - half)]
        spread[v] = np.interp(np.arange(spread.shape[1]), at, local_spread(beside, max(around // n, 3)))
    return spread


def local_spread(values: np.ndarray, rows: int) -> np.ndarray:
    """(N,) standard deviation of (N, W) values around each row, from blocks of at least so many rows, interpolated
    between them.

    Of a block it is that of a normal distribution whose middle third of absolute deviations from the median has the
    same mean: as little moved by few lines there as the median of them, and steadier.
    """
    count = max(len(values) // rows, 1)
    rows = len(values) // count
    first = (len(values) - count * rows) // 2       # the same from either end
    blocks = values[first:first + count * rows].reshape(count, -1)
    apart = np.sort(np.abs(blocks - middle(blocks)[:, None]), axis=1)
    third = apart.shape[1] // 3
    spread = apart[:, third:apart.shape[1] - third].mean(axis=1) / MIDDLE_THIRD + 1e-12
    return np.interp(np.arange(len(values)), first + (np.arange(count) + 0.5) * rows - 0.5, spread)


def search(strips: Strips, shadows: np.ndarray, smooth: int = 9) -> Measurement:
    """Where the darkest line that fits its plane's profile, a row of `shadows` (V, w), narrower than the strips, lies
    in each, averaged over `smooth` strips.

    Worth FOUND_PX; worth nothing where the line found is much fainter or darker than it usually is: there something
    hides the device.
    """
    half = (shadows.shape[1] - 1) // 2
    inner = slice(half // 2, -(half // 2) or None)
    response = np.stack([cv2.blur(darkness_across(p, t), (1, smooth))[:, inner]
                         for p, t in zip(strips.profiles, shadows)])
    best = np.argmax(response, axis=2)
    at = np.clip(best, 1, response.shape[2] - 2)[..., None] + np.array([-1, 0, 1])
    before, darkest, after = np.moveaxis(np.take_along_axis(response, at, axis=2), 2, 0)
    # where the parabola through the three is highest
    beside = 0.5 * (before - after) / np.minimum(before - 2 * darkest + after, -1e-9)
    usual = np.array([max(float(middle(d[i])) if i.any() else 1.0, 1e-9)
                      for d, i in zip(darkest, strips.inside)])[:, None]
    strength = darkest / usual
    believed = strips.inside & (strength > PALE)
    unknown = np.ones(len(strength))
    return Measurement(strips.offsets_px[inner][best] + np.clip(beside, -0.5, 0.5),
                       np.where(believed, FOUND_PX**2, np.inf), strength, unknown, unknown,
                       np.broadcast_to(usual, strength.shape))


def _running_median(values: np.ndarray, good: np.ndarray, width: int = 61) -> np.ndarray:
    """(N,) typical darkness around each strip: median over blocks of `width` good strips, interpolated between them;
    NaN without any."""
    at = np.nonzero(good & np.isfinite(values))[0]
    if len(at) == 0:
        return np.full(len(values), np.nan)
    width = min(width, len(at))
    blocks = at[:len(at) // width * width].reshape(-1, width)
    medians = middle(values[blocks])
    overall = float(middle(medians))
    medians = np.minimum(np.maximum(medians, PALER * overall), DARKER * overall) if overall > 0 else medians
    return np.interp(np.arange(len(values)), blocks @ np.full(width, 1 / width), medians)
