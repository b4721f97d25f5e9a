"""The image seen from along the curve: strips across it, and what they say about where it lies and where it ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import uniform_filter1d

from .curve import middle
from .data import View
from .geometry import distort


TOGETHER = 25           # strips along which a structured background errs the same way
MISFIT = 1.25           # mean square of a strip's rest, in noise variances, that noise alone rarely exceeds over TOGETHER strips
BLUR_PX = 1.0           # of an image, beside the device's own shape
PIECE = 31              # strips
STRETCH = 3             # pieces: longer than what hides a device
OUTER = 0.02            # of a shadow: what is fainter lies beside the device
SMOOTHED = 4            # px to either side, over which a line seen pixel by pixel is smoothed
USUAL_WIDTH = 0.88      # of a device whose radius is known, since most images are sharper than BLUR_PX
WIDER_PX, NARROWER_PX = 0.5, 0.7        # what that may be off by
WIDTHS = np.geomspace(0.5, 2.0, 21)      # 1 is among them


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
        """Both halves of the N strips as if planes of their own showed them: (2 V, N / 2), both of plane A, both of plane B."""
        half = (2 * len(self.speed), -1)
        return Strips(*(a.reshape(*half, *a.shape[2:]) for a in (self.centers_px, self.normals, self.speed, self.profiles)), self.offsets_px,
                      self.inside.reshape(half), self.lit.reshape(half))


@dataclass(frozen=True)
class Measurement:
    """What each strip says."""

    offset_px: np.ndarray       # (V, N) of the device's centre along the normal
    variance: np.ndarray        # (V, N) of it, px^2
    presence: np.ndarray        # (V, N) 1: as dark as the device usually is, 0: nothing there
    presence_sigma: np.ndarray  # (V,) standard deviation of `presence` from noise


def half_width_range(half_width_px: float) -> float:
    """How far a strip reaches to either side, px: the blurred device and some background."""
    return float(np.ceil(1.6 * half_width_px + 5.0))


def cut(images, fields, views, points: np.ndarray, tangents: np.ndarray, reach_px: float, rough: bool = False) -> Strips:
    """Strips of the (H, W) float32 images across the projections of (N, 3) points with (N, 3) tangents dX/ds, one a point and plane.

    rough: interpolated linearly, several times as fast; for what is looked for to a pixel.
    """
    centers, normals, speed = lay_out(views, points, tangents)
    offsets = np.arange(-reach_px, reach_px + 1)
    profiles = np.empty((*speed.shape, len(offsets)), np.float32)
    inside, lit = np.empty(speed.shape, bool), np.empty(speed.shape, bool)
    for k, plane in enumerate(zip(images, fields, views, centers, normals)):
        profiles[k], inside[k], lit[k] = _sample(*plane, offsets, cv2.INTER_LINEAR if rough else cv2.INTER_CUBIC)
    return Strips(centers, normals, speed, profiles, offsets, inside, lit)


def lay_out(views, points: np.ndarray, tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, normals and speed of the strips across the projections of (N, 3) points with (N, 3) tangents dX/ds, see Strips."""
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


def places(view: View | None, centers: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, W) float32 u and v in the image as received, of the samples of N strips at (W,) offsets."""
    u, v = (c[:, None] + n[:, None] * offsets.astype(np.float32) for c, n in zip(centers.T.astype(np.float32), normals.T.astype(np.float32)))
    if view is not None and view.distortion is not None:
        u, v = distort(view, np.stack([u, v], axis=2).reshape(-1, 2)).T.reshape(2, *u.shape).astype(np.float32)
    return u, v


def cut_along(image: np.ndarray, field: np.ndarray, lines_px: list[np.ndarray], reach_px: float) -> tuple[Strips, np.ndarray]:
    """Strips across (N, 2) lines of image pixels about a pixel apart, at every third; and of which line each strip is."""
    lengths = np.array([len(line) for line in lines_px])
    last = np.cumsum(lengths) - 1
    at, of = (np.concatenate(x) for x in zip(*((np.arange(stop - n + 1, stop + 1, 3), np.full(-(-n // 3), k)) for k, (n, stop) in enumerate(zip(lengths, last)))))
    points = np.concatenate(lines_px)
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(points, axis=0)])
    low, high = np.maximum(at - SMOOTHED, (last - lengths + 1)[of]), np.minimum(at + SMOOTHED, last[of])
    centers = (total[high + 1] - total[low]) / (high + 1 - low)[:, None]
    along = (total[high + 1] - total[at]) / (high + 1 - at)[:, None] - (total[at + 1] - total[low]) / (at + 1 - low)[:, None]     # from the mean behind to that ahead
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / (np.hypot(along[:, 0], along[:, 1]) + 1e-9)[:, None]
    offsets = np.arange(-reach_px, reach_px + 1)
    profiles, inside, lit = _sample(image, field, None, centers, normals, offsets)
    return Strips(centers, normals, np.ones(len(centers)), profiles, offsets, inside, lit), of


def _sample(image, field, view: View | None, centers, normals, offsets, interpolation: int = cv2.INTER_CUBIC) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, W) values, (N,) whether the whole strip lies in the field and (N,) whether its middle does."""
    u, v = places(view, centers, normals, offsets)
    profiles = cv2.remap(image, u, v, interpolation, borderMode=cv2.BORDER_REPLICATE)
    ends = [0, len(offsets) // 2, -1]
    exposed = cv2.remap(field, u[:, ends], v[:, ends], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return profiles, exposed.all(axis=1), exposed[:, 1]


def likeness(profiles: np.ndarray, half_width_px: float) -> np.ndarray:
    """(..., K) correlation of (..., W) profiles, one sample a px about their middles, with the shadows of cylinders WIDTHS times as wide.

    A smooth background (parabola) is taken off both.
    """
    basis, shadows = _cylinders(round(100 * half_width_px), profiles.shape[-1])
    a = profiles @ basis @ basis.T - profiles
    return a @ shadows.T / (np.linalg.norm(a, axis=-1, keepdims=True) + 1e-12)


@lru_cache(256)
def _cylinders(half_width_cpx: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(W, 3) orthonormal parabolas, and (K, W) shadows without them, of unit norm."""
    x = np.arange(count) - count // 2
    basis, _ = np.linalg.qr(np.vander(x / x[-1], 3))
    shadows = np.stack([shadow(half_width_cpx / 100 * k, x) for k in WIDTHS])
    shadows -= shadows @ basis @ basis.T
    return basis, shadows / np.linalg.norm(shadows, axis=1, keepdims=True)


def apparent_width(alike: list[np.ndarray]) -> tuple[float, np.ndarray]:
    """How many times as wide as expected a device looks, the same in all V planes, and the (V,) likeness of each with a cylinder so wide.

    alike: (B, K) `likeness` of its pieces in each plane. The median piece counts: some may run along another edge.
    """
    typical = np.stack([middle(a, axis=0) if len(a) else np.zeros(len(WIDTHS)) for a in alike])
    best = int(typical.min(axis=0).argmax())
    return float(WIDTHS[best]), typical[:, best]


def best_of_worst(alike: np.ndarray) -> float:
    """Of (B,) likenesses of successive pieces the best of the STRETCH worst ones in a row: low only where a line looks like nothing round for long."""
    if len(alike) < STRETCH:
        return float(alike.max(initial=0.0))
    return float(sliding_window_view(alike, STRETCH).max(axis=1).min())


def odd_width(width: float, half_width_px: float) -> float:
    """By how much `width` (see `apparent_width`) is wider or narrower than a device of this half width ever looks, as a natural logarithm; 0 where it is not.

    Images are not all equally sharp, which counts the more the fewer pixels there are.
    """
    ratio = np.log(width / USUAL_WIDTH)
    return float(max(ratio - np.log1p(WIDER_PX / half_width_px), -ratio - np.log1p(NARROWER_PX / half_width_px), 0.0))


def pieces(profiles: np.ndarray, good: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(B, W) medians of successive PIECE `good` ones among (N, W) profiles, and of which line each is; one of all where a line has fewer.

    of: (N,) ascending, the line of each profile; all are of one by default.
    """
    at = np.nonzero(good)[0]
    of = np.zeros(len(at), int) if of is None else of[at]
    first = np.searchsorted(of, np.arange(of[-1] + 2 if len(of) else 1))
    counts = np.diff(first)
    number = np.maximum(counts // PIECE, counts > 0)
    line = np.repeat(np.arange(len(counts)), number)
    place = np.arange(len(line)) - np.repeat(np.cumsum(number) - number, number)
    within = (PIECE * place[:, None] + np.arange(PIECE)) % np.maximum(counts[line], 1)[:, None]    # a short line goes round and round
    return middle(profiles[at[first[line][:, None] + within]], axis=1), line


def mean_profile(profiles: np.ndarray, good: np.ndarray) -> np.ndarray:
    """(W,) median of the good ones among (N, W) profiles; all equal where there are none."""
    return middle(profiles[good], axis=0) if good.any() else np.ones(profiles.shape[-1])


def shadow(half_width_px: float, offsets_px: np.ndarray) -> np.ndarray:
    """(W,) profile across a cylinder's shadow of unit depth: the chord sqrt(h^2 - x^2), blurred. h counts in hundredths of a px."""
    return np.interp(offsets_px, *_shadow(round(100 * half_width_px)), 0.0, 0.0)


@lru_cache(1024)
def _shadow(half_width_cpx: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets in px, 0.125 apart, and the blurred chord there."""
    reach = half_width_cpx / 100 + 5 * BLUR_PX
    x = np.arange(-np.ceil(reach), np.ceil(reach) + 1e-9, 0.125)
    chord = np.sqrt(np.maximum((half_width_cpx / 100) ** 2 - x**2, 0))
    kernel = np.exp(-0.5 * (np.arange(-32, 33) * 0.125 / BLUR_PX) ** 2)
    blurred = np.convolve(chord, kernel / kernel.sum(), mode='same')
    return x, blurred / blurred.max()


def own_shadow(profiles: np.ndarray, beside: np.ndarray, good: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(W,) the device's mean over the `good` ones of (N, W) profiles, made symmetric, unit depth; the `expected` one where there is too little of it.

    beside: see `background`.
    """
    if good.sum() < 20:
        return expected
    mean = middle(profiles[good][::2], axis=0)
    dark = beside @ mean - mean
    dark = np.where(expected < OUTER, 0.0, 0.5 * (dark + dark[::-1]))
    return dark / dark.max() if dark.max() > 0 and expected @ dark > 0.7 * np.sqrt((expected @ expected) * (dark @ dark)) else expected


def background(expected: np.ndarray, offsets_px: np.ndarray) -> np.ndarray:
    """(W, W) what gives of a profile the straight line through what is beside a device of the (W,) `expected` shadow."""
    line = np.vander(offsets_px / offsets_px[-1], 2)
    outer = np.nonzero(expected < OUTER)[0]
    beside = np.zeros((len(line), len(line)))
    beside[:, outer] = line @ np.linalg.solve(line[outer].T @ line[outer], line[outer].T)
    return beside


@dataclass(frozen=True)
class Model:
    """What a strip is made of: I = b0 + b1 x + b2 x^2 - c (T(x) - d T'(x)), background, darkness and shift of the device's profile T."""

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
    noise = (1.4826 * np.sqrt(width / (width - 5)) * middle(np.abs(rest[:, ::2]).reshape(len(rest), -1)) + 1e-9)[:, None]
    inside = strips.inside
    darkness = np.where(inside, -coefficients[..., 3], np.nan)
    usual = np.stack([_running_median(d, i) for d, i in zip(darkness, inside if reference is None else inside & reference)])
    usual[~(usual > 1e-9)] = np.nan         # no darkness at all, or brighter than its surroundings: no device to measure
    offset = coefficients[..., 4] / usual
    gain = np.sqrt((fit * fit).sum(axis=2))
    variance = (noise * gain[:, 4:] / usual) ** 2
    # A background that is no parabola pulls neighbouring strips the same way: there their errors do not average out.
    square = rest * rest
    limit = 9 * noise**2
    misfit = uniform_filter1d(np.minimum(np.einsum('vnw->vn', square) / (width - 5), limit), TOGETHER, axis=1) / noise**2
    variance *= 1 + TOGETHER * np.maximum(misfit - MISFIT, 0)
    odd = np.einsum('vnw->vn', np.minimum(square, limit[..., None])) > 3.5 * width * noise**2   # another edge runs through: not to be trusted
    variance[~inside | odd | np.isnan(variance)] = np.inf
    sigma = np.array([n * g / middle(u) if np.isfinite(u[0]) else np.inf for n, g, u in zip(noise[:, 0], gain[:, 3], usual)])
    offset[np.isnan(offset)] = 0.0
    return Measurement(offset, variance, darkness / usual, sigma)


def search(strips: Strips, shadows: np.ndarray, smooth: int = 9) -> Measurement:
    """Where the darkest line that fits its plane's profile, a row of `shadows` (V, w), narrower than the strips, lies in each, averaged over `smooth` strips.

    Worth about a pixel; worth nothing where the line found is much fainter or darker than it usually is: there something hides the device.
    """
    half = (shadows.shape[1] - 1) // 2
    inner = slice(half // 2, -(half // 2) or None)
    kernels = (shadows - shadows.mean(axis=1, keepdims=True)).astype(np.float32)
    response = np.stack([cv2.blur(-cv2.filter2D(p, cv2.CV_32F, k[None], borderType=cv2.BORDER_REPLICATE), (1, smooth))[:, inner]
                         for p, k in zip(strips.profiles, kernels)])
    best = np.argmax(response, axis=2)
    darkest = np.take_along_axis(response, best[..., None], axis=2)[..., 0]
    usual = [max(float(middle(d[i])) if i.any() else 1.0, 1e-9) for d, i in zip(darkest, strips.inside)]
    strength = darkest / np.array(usual)[:, None]
    believed = strips.inside & (strength > 0.4) & (strength < 2.5)
    return Measurement(strips.offsets_px[inner][best], np.where(believed, 1.0, np.inf), strength, np.ones(len(strength)))


def _running_median(values: np.ndarray, good: np.ndarray, width: int = 61) -> np.ndarray:
    """(N,) typical darkness around each strip: median over blocks of `width` good strips, interpolated between them; NaN without any."""
    at = np.nonzero(good & np.isfinite(values))[0]
    if len(at) == 0:
        return np.full(len(values), np.nan)
    width = min(width, len(at))
    blocks = at[:len(at) // width * width].reshape(-1, width)
    medians = middle(values[blocks])
    overall = float(middle(medians))
    medians = np.minimum(np.maximum(medians, 0.4 * overall), 2.5 * overall) if overall > 0 else medians
    return np.interp(np.arange(len(values)), blocks @ np.full(width, 1 / width), medians)
