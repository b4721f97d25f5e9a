"""Where an image shows X-ray at all: not collimator blades, not the corners around a circular intensifier."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

SHRINK = 4              # the field is found at a quarter of the resolution: two halvings
DARK = 0.12, 0.07, 0.04, 0.02   # darker than this share of the bright level counts as not exposed, the first for which the rest is convex ...
BRIGHT = 0.95           # ... which this share of the pixels does not exceed
OPENING = 9             # small-image px: a device is thinner, a blade is wider
CONVEX = 0.975          # share of its convex hull that a field fills: blades and an intensifier leave a convex one open, dense anatomy does not


def field_of_view(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 mask, 255 where the (H, W) image is exposed.

    Unexposed is what is dark, wider than any device and connected with the image's border, if what it leaves is convex.
    """
    h, w = image.shape
    small = image
    for _ in range(2):      # OpenCV is many times faster at halving
        small = cv2.resize(small, (-(-small.shape[1] // 2), -(-small.shape[0] // 2)), interpolation=cv2.INTER_AREA)
    small = small.astype(np.float32)
    small -= min(0.0, float(small.min()))
    some = small.ravel()[::7]
    bright = np.partition(some, int(BRIGHT * len(some)))[int(BRIGHT * len(some))]
    for share in DARK:
        blocked = _blocked(small < share * bright)
        if blocked is None:
            break
        if _is_convex(~blocked):
            return cv2.resize((~blocked).astype(np.uint8) * 255, (w, h), interpolation=cv2.INTER_NEAREST)
    return _open(h, w)


def _blocked(dark: np.ndarray) -> np.ndarray | None:
    """(h, w) bool: what of the (h, w) `dark` is wide and connected with the border; None where nothing is."""
    if not dark.any():
        return None
    framed = cv2.copyMakeBorder(dark.astype(np.uint8), OPENING, OPENING, OPENING, OPENING, cv2.BORDER_REPLICATE)
    framed = cv2.morphologyEx(framed, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (OPENING, OPENING)))
    _, labels = cv2.connectedComponents(framed[OPENING:-OPENING, OPENING:-OPENING])
    outside = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    blocked = np.isin(labels, outside[outside > 0])
    return blocked if blocked.any() else None


def _is_convex(lit: np.ndarray) -> bool:
    """Whether an (h, w) bool region fills its convex hull."""
    v, u = np.nonzero(lit)
    if not len(u):
        return False
    hull = np.zeros(lit.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.stack([u, v], axis=1).astype(np.int32)), 1)
    return bool(len(u) > CONVEX * np.count_nonzero(hull))


@lru_cache(8)
def _open(h: int, w: int) -> np.ndarray:
    """All exposed; shared, so not to be written to."""
    field = np.full((h, w), 255, np.uint8)
    field.flags.writeable = False
    return field


def border_distance(field: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N,) distance in px of (N, 2) points from the border of the exposed field (the image's border included), to about SHRINK px."""
    small = np.ascontiguousarray(field[::SHRINK, ::SHRINK])
    distance = cv2.distanceTransform(cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), cv2.DIST_L2, 5)[1:-1, 1:-1]
    h, w = field.shape
    i = np.clip(np.round(points_px / SHRINK).astype(int), 0, np.array(small.shape)[::-1] - 1)
    to_edge = np.min(np.c_[points_px, np.array([w, h]) - 1 - points_px], axis=1)
    return np.minimum((distance[i[:, 1], i[:, 0]] - 0.5) * SHRINK, to_edge)
