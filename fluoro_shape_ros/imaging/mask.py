"""Digital subtraction: a device-free image of the same scene, taken before, is taken off each image."""

from __future__ import annotations

import cv2
import numpy as np

SHRINK = 4              # the shift is estimated at a quarter of the resolution: sub-pixel there is enough
LOCAL = 29              # px there: what varies more slowly than this is level, not structure
MAX_SHIFT_PX = 12.0
STILL_PX = 0.05         # a shift of less is not worth an interpolation


def subtract(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 image over mask: the share of the beam that was let through since, scaled to the mask's mean.

    A division of counts is the subtraction of their logarithms (DSA). A sub-pixel shift between the two is estimated by
    phase correlation and removed.
    """
    image = image.astype(np.float32)
    du, dv = shift_between(mask, image)
    if max(abs(du), abs(dv)) < STILL_PX:
        moved = mask.copy()
    else:
        moved = cv2.warpAffine(mask, np.array([[1, 0, du], [0, 1, dv]], np.float32), mask.shape[::-1],
                               flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = float(moved.mean())
    floor = np.float32(max(0.02 * level, 1e-6))     # unexposed: nothing was let through before either
    image += floor
    moved += floor
    cv2.divide(image, moved, image, scale=level)
    return np.clip(image, 0, 2 * level, out=image)


def shift_between(mask: np.ndarray, image: np.ndarray) -> tuple[float, float]:
    """u, v in px by which the scene of (H, W) `mask` has moved in `image`; 0, 0 where no believable shift is found."""
    small = [cv2.resize(i.astype(np.float32), None, fx=1 / SHRINK, fy=1 / SHRINK, interpolation=cv2.INTER_AREA)
             for i in (mask, image)]
    small = [i - cv2.blur(i, (LOCAL, LOCAL)) for i in small]
    # phaseCorrelate pads to a DFT size and errs by half a pixel where that is odd
    h, w = (_even_dft_size(n) for n in small[0].shape)
    small = [np.ascontiguousarray(i[:h, :w]) for i in small]
    (du, dv), response = cv2.phaseCorrelate(*small, cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F))
    if response < 0.05 or max(abs(du), abs(dv)) * SHRINK > MAX_SHIFT_PX:
        return 0.0, 0.0
    return du * SHRINK, dv * SHRINK


def _even_dft_size(n: int) -> int:
    """The largest even size up to n that the DFT takes as it is."""
    while n % 2 or cv2.getOptimalDFTSize(n) != n:
        n -= 1
    return n
