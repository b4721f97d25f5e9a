"""Lines too faint to be seen pixel by pixel: a matched filter that averages along them, in all directions.

The filter is the second derivative of a Gaussian across a line and a Gaussian along it (the profile that Canny 1986
takes for ridges), in the frequency domain w_v^2 exp(-(sigma w_v)^2 / 2) exp(-(length w_u)^2 / 2), so that one transform
of the image serves all directions. It gains in signal to noise as the root of its length over a filter that is round.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

DIRECTIONS = 12         # 15 degrees apart: half of that is what a line of LENGTH sigma may be off by


def along_lines(image: np.ndarray, sigma_px: float, length_px: float) -> np.ndarray:
    """(H, W) float32: how dark a line of scale `sigma_px`, averaged over some 2.5 `length_px`, is at each pixel of the
    (H, W) float32 image in the best direction; 0 on average where there is nothing, in units of the image."""
    margin = int(np.ceil(2.5 * max(sigma_px, length_px)))
    padded = np.pad(image, margin, mode='symmetric')
    shape = tuple(fft.next_fast_len(n) for n in padded.shape)
    spectrum = fft.fft2(padded, s=shape)
    best: np.ndarray | None = None
    for pair in _spectra(shape, round(100 * sigma_px), round(100 * length_px)):
        # the image is real and the filters even: one direction is real, the other imaginary
        both = fft.ifft2(spectrum * pair, overwrite_x=True)
        found = np.maximum(both.real, both.imag)
        best = found if best is None else np.maximum(best, found, out=best)
    h, w = image.shape
    assert best is not None     # there are directions
    return np.ascontiguousarray(best[margin:margin + h, margin:margin + w])


@lru_cache(8)
def _spectra(shape: tuple[int, int], sigma_cpx: int, length_cpx: int) -> list[np.ndarray]:
    """The filters' transforms, complex64, two directions in each: one as its real, one as its imaginary part."""
    sigma, length = sigma_cpx / 100, length_cpx / 100
    wv, wu = (2 * np.pi * fft.fftfreq(n).astype(np.float32) for n in shape)
    filters = []
    for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        along = np.cos(angle) * wu + np.sin(angle) * wv[:, None]
        across = np.cos(angle) * wv[:, None] - np.sin(angle) * wu
        # minus the second derivative of what is dark is positive: w^2, times sigma^2 so that it does not depend on the
        # scale
        filters.append(-sigma**2 * across**2 * np.exp(-0.5 * ((sigma * across)**2 + (length * along)**2)))
    return [(a + 1j * b).astype(np.complex64) for a, b in zip(filters[::2], filters[1::2])]
