"""Where an image shows X-ray at all: not collimator blades, not the corners around a circular intensifier."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from .collimation import outlines

SMALLEST_PX = 100       # of an image's smaller side, to which it may be halved again and again: blades are wide
MOST = 2**16            # pixels that edges are looked for in
SHRINK = 4              # distances from its border are known to so many px


def field_of_view(image: np.ndarray, polarity: str = 'dark') -> np.ndarray:
    """(H, W) uint8 mask, 255 where the (H, W) image is exposed; what is not is the brighter side where the device is
    `bright`, either where that is `auto`."""
    h, w = image.shape
    small = image
    while min(small.shape) >= 2 * SMALLEST_PX or small.size > MOST:     # OpenCV is many times faster at halving
        small = cv2.resize(small, (-(-small.shape[1] // 2), -(-small.shape[0] // 2)), interpolation=cv2.INTER_AREA)
    small = cv2.normalize(small, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_32F)     # squares of any grey levels fit then
    found = [o for bright in (False, True) if polarity in ('auto', ('dark', 'bright')[bright])
             for o in outlines(255 - small if bright else small)]
    if not found:
        return _open(h, w)
    field, scale = np.full((h, w), 255, np.uint8), (w / small.shape[1], h / small.shape[0])
    for outline in found:
        outline.draw(field, scale)
    return field


def common_field(image: np.ndarray, mask: np.ndarray | None, polarity: str = 'dark') -> np.ndarray:
    """(H, W) uint8, 255 where an image is exposed, and the mask that is taken off it (None: none) was: blades may have
    moved since."""
    field = field_of_view(image, polarity)
    return field if mask is None else cv2.min(field, field_of_view(mask, polarity))


@lru_cache(8)
def _open(h: int, w: int) -> np.ndarray:
    """All exposed; shared, so not to be written to."""
    field = np.full((h, w), 255, np.uint8)
    field.flags.writeable = False
    return field


def border_distance(field: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N,) distance in px of (N, 2) points from the border of the exposed field (the image's border included), to about
    SHRINK px."""
    small = np.ascontiguousarray(field[::SHRINK, ::SHRINK])
    distance = cv2.distanceTransform(cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), cv2.DIST_L2,
                                     5)[1:-1, 1:-1]
    h, w = field.shape
    i = np.clip(np.round(points_px / SHRINK).astype(int), 0, np.array(small.shape)[::-1] - 1)
    to_edge = np.min(np.c_[points_px, np.array([w, h]) - 1 - points_px], axis=1)
    return np.minimum((distance[i[:, 1], i[:, 0]] - 0.5) * SHRINK, to_edge)
