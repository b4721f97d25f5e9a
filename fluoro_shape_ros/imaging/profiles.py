"""The profile across a device: what a cylinder's shadow looks like, and how much a profile seen is like one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..geometry.curve import middle

BLUR_PX = 1.0           # of an image, beside the device's own shape
PIECE = 31              # strips
OUTER = 0.02            # of a shadow: what is fainter lies beside the device
USUAL_WIDTH = 0.88      # of a device whose radius is known, since most images are sharper than BLUR_PX
WIDER_PX, NARROWER_PX = 0.5, 0.7        # what that may be off by
WIDTHS = np.geomspace(0.5, 2.0, 21)      # 1 is among them


def likeness(profiles: np.ndarray, half_width_px: float, noise: float = 0.0) -> np.ndarray:
    """(..., K) correlation of (..., W) profiles, one sample a px about their middles, with the shadows of cylinders
    WIDTHS times as wide.

    A smooth background (parabola) is taken off both. noise: standard deviation of a sample; what it takes from the
    correlation is given back (Spearman 1904, for attenuation), unless it is most of the profile.
    """
    basis, shadows = _cylinders(round(100 * half_width_px), profiles.shape[-1])
    a = profiles @ basis @ basis.T - profiles
    total = np.einsum('...w,...w->...', a, a)[..., None]
    return np.minimum(a @ shadows.T
                      / np.sqrt(np.maximum(total - (profiles.shape[-1] - 3) * noise**2, 0.5 * total) + 1e-24), 1.0)


@lru_cache(256)
def _cylinders(half_width_cpx: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(W, 3) orthonormal parabolas, and (K, W) shadows without them, of unit norm."""
    x = np.arange(count) - count // 2
    basis, _ = np.linalg.qr(np.vander(x / x[-1], 3))
    shadows = np.stack([shadow(half_width_cpx / 100 * k, x) for k in WIDTHS])
    shadows -= shadows @ basis @ basis.T
    return basis, shadows / np.linalg.norm(shadows, axis=1, keepdims=True)


def apparent_width(alike: list[np.ndarray]) -> tuple[float, np.ndarray]:
    """How many times as wide as expected a device looks, the same in all V planes, and the (V,) likeness of each with a
    cylinder so wide.

    alike: (B, K) `likeness` of its pieces in each plane. The median piece counts: some may run along another edge.
    """
    typical = np.stack([middle(a, axis=0) if len(a) else np.zeros(len(WIDTHS)) for a in alike])
    best = int(typical.min(axis=0).argmax())
    return float(WIDTHS[best]), typical[:, best]


def odd_width(width: float, half_width_px: float) -> float:
    """By how much `width` (see `apparent_width`) is wider or narrower than a device of this half width ever looks, as a
    natural logarithm; 0 where it is not.

    Images are not all equally sharp, which counts the more the fewer pixels there are.
    """
    ratio = np.log(width / USUAL_WIDTH)
    return float(max(ratio - np.log1p(WIDER_PX / half_width_px), -ratio - np.log1p(NARROWER_PX / half_width_px), 0.0))


def pieces(profiles: np.ndarray, good: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(B, W) medians of successive PIECE `good` ones among (N, W) profiles, and of which line each is; one of all where
    a line has fewer.

    of: (N,) ascending, the line of each profile; all are of one by default.
    """
    at = np.nonzero(good)[0]
    of = np.zeros(len(at), int) if of is None else of[at]
    first = np.searchsorted(of, np.arange(of[-1] + 2 if len(of) else 1))
    counts = np.diff(first)
    number = np.maximum(counts // PIECE, counts > 0)
    line = np.repeat(np.arange(len(counts)), number)
    place = np.arange(len(line)) - np.repeat(np.cumsum(number) - number, number)
    # a short line goes round and round
    within = (PIECE * place[:, None] + np.arange(PIECE)) % np.maximum(counts[line], 1)[:, None]
    return middle(profiles[at[first[line][:, None] + within]], axis=1), line


def shadow(half_width_px: float, offsets_px: np.ndarray) -> np.ndarray:
    """(W,) profile across a cylinder's shadow of unit depth: the chord sqrt(h^2 - x^2), blurred. h counts in hundredths
    of a px."""
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
    """(W,) the device's mean over the `good` ones of (N, W) profiles, made symmetric, unit depth; the `expected` one
    where there is too little of it.

    beside: see `background`.
    """
    if good.sum() < 20:
        return expected
    mean = middle(profiles[good][::2], axis=0)
    dark = beside @ mean - mean
    dark = np.where(expected < OUTER, 0.0, 0.5 * (dark + dark[::-1]))
    return (dark / dark.max()
            if dark.max() > 0 and expected @ dark > 0.7 * np.sqrt((expected @ expected) * (dark @ dark)) else expected)


def background(expected: np.ndarray, offsets_px: np.ndarray) -> np.ndarray:
    """(W, W) what gives of a profile the straight line through what is beside a device of the (W,) `expected`
    shadow."""
    line = np.vander(offsets_px / offsets_px[-1], 2)
    outer = np.nonzero(expected < OUTER)[0]
    beside = np.zeros((len(line), len(line)))
    beside[:, outer] = line @ np.linalg.solve(line[outer].T @ line[outer], line[outer].T)
    return beside
