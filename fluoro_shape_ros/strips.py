"""The image seen from along the curve: strips across it, and what they say about where it lies and where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d

from .data import View
from .geometry import distort, project


TOGETHER = 25           # strips along which a structured background errs the same way
MISFIT = 1.25           # mean square of a strip's rest, in noise variances, that noise alone rarely exceeds over TOGETHER strips


@dataclass(frozen=True)
class Strips:
    """Profiles across the projected curve in one plane."""

    centers_px: np.ndarray  # (N, 2) undistorted pixels
    normals: np.ndarray     # (N, 2) unit, across the curve
    speed: np.ndarray       # (N,) px per m of arc length: foreshortening shows here
    profiles: np.ndarray    # (N, W) image values at offsets
    offsets_px: np.ndarray  # (W,)
    inside: np.ndarray      # (N,) bool: the whole strip lies in the exposed field
    lit: np.ndarray         # (N,) bool: its middle does


@dataclass(frozen=True)
class Measurement:
    """What each strip says."""

    offset_px: np.ndarray   # (N,) of the device's centre along the normal
    variance: np.ndarray    # (N,) of it, px^2
    presence: np.ndarray    # (N,) 1: as dark as the device usually is, 0: nothing there
    presence_sigma: float   # standard deviation of `presence` from noise


def half_width_range(half_width_px: float) -> float:
    """How far a strip reaches to either side, px: the blurred device and some background."""
    return float(np.ceil(1.6 * half_width_px + 5.0))


def cut(image: np.ndarray, field: np.ndarray, view: View, points: np.ndarray, tangents: np.ndarray, reach_px: float) -> Strips:
    """Strips of the (H, W) float32 image across the projections of (N, 3) points with (N, 3) tangents dX/ds, one a point."""
    centers = project(view.P, points)
    ahead = project(view.P, points + 1e-5 * tangents)
    step = (ahead - centers) / 1e-5
    speed = np.linalg.norm(step, axis=1)
    tangent = step / np.maximum(speed, 1e-9)[:, None]
    normals = np.c_[-tangent[:, 1], tangent[:, 0]]
    return _sample(image, field, view, centers, normals, speed, reach_px)


def cut_along(image: np.ndarray, field: np.ndarray, points_px: np.ndarray, reach_px: float) -> Strips:
    """Strips across an (N, 2) line of image pixels about a pixel apart, at every third."""
    smooth = uniform_filter1d(points_px, 9, axis=0, mode='nearest')
    tangent = np.gradient(smooth, axis=0)[::3]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
    centers = smooth[::3]
    return _sample(image, field, None, centers, np.c_[-tangent[:, 1], tangent[:, 0]], np.ones(len(centers)), reach_px)


def _sample(image, field, view: View | None, centers, normals, speed, reach_px: float) -> Strips:
    x = np.arange(-reach_px, reach_px + 1)
    at = centers[:, None] + x[None, :, None] * normals[:, None]
    if view is not None and view.distortion is not None:
        at = distort(view, at.reshape(-1, 2)).reshape(at.shape)
    at = at.astype(np.float32)
    profiles = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    ends = [0, len(x) // 2, -1]
    exposed = cv2.remap(field, at[:, ends, 0], at[:, ends, 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return Strips(centers, normals, speed, profiles, x, (exposed > 0).all(axis=1), exposed[:, 1] > 0)


def likeness(profile: np.ndarray, half_width_px: float) -> float:
    """Correlation of a (W,) profile, one sample a px about its middle, with a cylinder's shadow; a smooth background (parabola) taken off both."""
    x = np.arange(len(profile)) - len(profile) // 2
    M = np.vander(x / x[-1], 3)
    a, b = (p - M @ np.linalg.lstsq(M, p, rcond=None)[0] for p in (-profile, shadow(half_width_px, x)))
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-12))


def mean_profile(strips: Strips, good: np.ndarray) -> np.ndarray:
    """(W,) median profile of the good strips inside the field; all equal where there are none."""
    rows = strips.profiles[good & strips.inside]
    return np.median(rows, axis=0) if len(rows) else np.ones(len(strips.offsets_px))


def shadow(half_width_px: float, offsets_px: np.ndarray, blur_px: float = 1.0) -> np.ndarray:
    """(W,) profile across a cylinder's shadow of unit depth: the chord sqrt(h^2 - x^2), blurred."""
    fine = np.arange(offsets_px[0] - 4, offsets_px[-1] + 4 + 1e-9, 0.125)
    chord = np.sqrt(np.maximum(half_width_px**2 - fine**2, 0))
    kernel = np.exp(-0.5 * (np.arange(-32, 33) * 0.125 / blur_px) ** 2)
    blurred = np.convolve(chord, kernel / kernel.sum(), mode='same')
    return np.interp(offsets_px, fine, blurred / blurred.max())


def own_shadow(strips: Strips, good: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(W,) the device's mean profile over the `good` strips, made symmetric, unit depth; the `expected` one where there is too little of it."""
    if good.sum() < 20:
        return expected
    x = strips.offsets_px
    mean = np.median(strips.profiles[good][::2], axis=0)
    outer = expected < 0.02
    base = np.polyval(np.polyfit(x[outer], mean[outer], 1), x) if outer.sum() > 3 else mean.max()
    dark = base - mean
    dark = 0.5 * (dark + dark[::-1])
    dark[outer] = 0
    return dark / dark.max() if dark.max() > 0 and expected @ dark > 0.7 * np.linalg.norm(expected) * np.linalg.norm(dark) else expected


def measure(strips: Strips, profile: np.ndarray, reference: np.ndarray | None = None) -> Measurement:
    """Least squares of each strip for background (parabola), darkness and shift of `profile`: I = b0 + b1 x + b2 x^2 - c (T(x) - d T'(x)).

    `reference` (N,) bool: the strips whose darkness counts as usual; all by default.
    """
    x = strips.offsets_px / strips.offsets_px[-1]
    M = np.stack([np.ones_like(x), x, x**2, profile, np.gradient(profile)], axis=1)
    fit = np.linalg.pinv(M)
    coefficients = strips.profiles @ fit.T
    rest = strips.profiles - coefficients @ M.T
    noise = 1.4826 * np.median(np.abs(rest)) * np.sqrt(len(x) / (len(x) - 5)) + 1e-9
    inside = strips.inside
    darkness = np.where(inside, -coefficients[:, 3], np.nan)
    usual = _running_median(darkness, inside if reference is None else inside & reference)
    usual = np.where(usual > 1e-9, usual, np.nan)       # no darkness at all, or brighter than its surroundings: no device to measure
    offset = coefficients[:, 4] / usual
    variance = np.nan_to_num(noise**2 * (fit[4] @ fit[4]) / usual**2, nan=np.inf)
    # A background that is no parabola pulls neighbouring strips the same way: there their errors do not average out.
    misfit = uniform_filter1d(np.minimum((rest**2).sum(axis=1) / (len(x) - 5), 9 * noise**2), TOGETHER) / noise**2
    variance = variance * (1 + TOGETHER * np.maximum(misfit - MISFIT, 0))
    odd = np.minimum(rest**2, 9 * noise**2).mean(axis=1) > 3.5 * noise**2   # another edge runs through: not to be trusted
    variance = np.where(inside & ~odd, variance, np.inf)
    sigma = noise * np.linalg.norm(fit[3]) / np.nanmedian(usual) if np.isfinite(usual).any() else np.inf
    return Measurement(np.nan_to_num(offset), variance, np.where(inside, darkness / usual, np.nan), float(sigma))


def search(strips: Strips, profile: np.ndarray, smooth: int = 9) -> Measurement:
    """Where the darkest line that fits `profile` (narrower than the strips) lies in each, averaged over `smooth` strips: a start within a few px.

    Worth about a pixel; worth nothing where the line found is much fainter or darker than it usually is: there something hides the device.
    """
    half = (len(profile) - 1) // 2
    kernel = profile - profile.mean()
    response = -cv2.filter2D(strips.profiles, cv2.CV_32F, kernel[None].astype(np.float32), borderType=cv2.BORDER_REPLICATE)
    response = cv2.blur(response, (1, smooth))[:, half // 2: -(half // 2) or None]
    x = strips.offsets_px[half // 2: -(half // 2) or None]
    best = np.argmax(response, axis=1)
    strength = response[np.arange(len(best)), best] / max(float(np.median(response.max(axis=1)[strips.inside])) if strips.inside.any() else 1.0, 1e-9)
    believed = strips.inside & (strength > 0.4) & (strength < 2.5)
    return Measurement(x[best], np.where(believed, 1.0, np.inf), strength, 1.0)


def _running_median(values: np.ndarray, good: np.ndarray, width: int = 61) -> np.ndarray:
    """(N,) typical darkness around each strip: median over blocks of `width` good strips, interpolated between them; NaN without any."""
    at = np.nonzero(good & np.isfinite(values))[0]
    if len(at) == 0:
        return np.full(len(values), np.nan)
    width = min(width, len(at))
    blocks = at[:len(at) // width * width].reshape(-1, width)
    medians = np.median(values[blocks], axis=1)
    overall = float(np.median(medians))
    medians = np.clip(medians, 0.4 * overall, 2.5 * overall) if overall > 0 else medians
    return np.interp(np.arange(len(values)), blocks.mean(axis=1), medians)
