"""Segmentations made upstream as the method wants them: an outline is the shadow of a device that lets nothing
through."""

from __future__ import annotations

import cv2
import numpy as np

SMOOTH = 0.5            # half widths: sigma of what takes bites and bumps off an outline
OPAQUE = 0.85           # share of the beam that the device takes
LEVEL = 1000.0          # counts beside it
BLUR, SHARPEST_PX = 0.25, 0.8   # half widths, and px at least: sigma of the blur of the shadow's edge
THINNEST = 0.5          # of its half width, that is left of an outline however much too thick it seems
GREYS, FULL = 8, 0.85   # so many grey levels and more, beside nearly all of the device at this share of the highest or
                        # above, are what JPEG makes of a silhouette


def outline(image: np.ndarray, half_width_px: float) -> np.ndarray:
    """(H, W) uint8, 1 where the (H, W) silhouette of a device of this half width shows it: all but 0, without islands
    and holes smaller than a disc as wide as it."""
    found, smallest = _device(image), np.pi * half_width_px**2
    near = cv2.dilate(found, np.ones((3, 3), np.uint8))     # a thin device that is broken is no island
    _, label = cv2.connectedComponents(near, connectivity=8)
    found &= _large(np.bincount(label[found > 0], minlength=int(label.max()) + 1), smallest)[label]
    box = _around(found, 1)
    if box is not None:
        _, label, stats, _ = cv2.connectedComponentsWithStats(1 - found[box], connectivity=4)
        found[box] |= 1 - _large(stats[:, cv2.CC_STAT_AREA], smallest)[label]
    return found


def shadow(found: np.ndarray, half_width_px: float) -> np.ndarray:
    """(H, W) float32, the X-ray image of a dark device of this half width whose (H, W) outline is found: smoothed, and
    as much thicker or thinner all around."""
    image = np.full(found.shape, LEVEL, np.float32)
    box = _around(found, int(4 * half_width_px) + 8)
    if box is None:
        return image
    smooth = cv2.GaussianBlur(found[box].astype(np.float32), (0, 0), SMOOTH * half_width_px) > 0.5
    if not smooth.any():        # thinner than it should be by far
        smooth = found[box] > 0
    inside = cv2.distanceTransform(smooth.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    seen = _half_width(inside)
    blur = max(BLUR * half_width_px, SHARPEST_PX)
    # has, blurred, the second moment of a cylinder's shadow
    wanted = np.sqrt(3 * (half_width_px**2 / 4 + SHARPEST_PX**2 - min(blur, half_width_px)**2))
    excess = min(seen - wanted, (1 - THINNEST) * seen)
    if excess < 0:
        device = cv2.distanceTransform((~smooth).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) < 0.5 - excess
    else:
        device = inside > 0.5 + excess
    blurred = cv2.GaussianBlur(device.astype(np.float32), (0, 0), blur)
    image[box] = LEVEL * (1 - OPAQUE * blurred)
    return image


def _device(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 1 where an (H, W) silhouette is not 0; one that JPEG has blurred is cut half-way."""
    least = 0
    if image.dtype == np.uint8 and image.any():
        counts, highest = cv2.calcHist([image], [0], None, [256], [0, 256]).ravel(), int(image.max())
        device = counts[highest // 2 + 1:].sum()
        if np.count_nonzero(counts) > GREYS and counts[int(FULL * highest):].sum() > FULL * device:
            least = highest // 2
    return (image > least).astype(np.uint8)


def _half_width(inside: np.ndarray) -> float:
    """px, of the (H, W) distance from the background in a device: the median along its middle, where that is nowhere
    larger."""
    middle = inside[(inside > 0) & (inside >= cv2.dilate(inside, np.ones((3, 3), np.uint8)))]
    # to the next pixel's centre: half the width or half a px more, where that is even or odd
    return float(np.median(middle)) - 0.25


def _large(areas: np.ndarray, smallest: float) -> np.ndarray:
    """(N,) uint8, 1 for labels of pieces at least so large; the first is what is no piece."""
    large = (areas >= smallest).astype(np.uint8)
    large[0] = 1
    return large


def _around(found: np.ndarray, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns of the (H, W) image within so many px of the device; None where there is none."""
    v, u = (np.flatnonzero(found.any(axis=k)) for k in (1, 0))
    if not len(v):
        return None
    return slice(max(v[0] - margin, 0), v[-1] + margin + 1), slice(max(u[0] - margin, 0), u[-1] + margin + 1)
