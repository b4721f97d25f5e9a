"""From an image to ridge points, sorted along the branches they form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..geometry.curve import middle

RIDGE_Z = 3.5           # ridge points stand out from the noise by this many standard deviations
MAX_RIDGE_SHARE = 0.015 # of the pixels, at most: the strongest
FEW_RIDGES = 16000      # pixels that are never too many
NARROWEST_PX = 0.9      # half the width that a device keeps at least, and ...
FINEST_SIGMA = 0.75     # ... the scale, where it is looked for in a smaller image
FAINTEST = 0.003        # of the strongest ridge
ONE_SIDED = 0.15        # the side that is less bright rises at least this much of the mean
NMS_PX = 0.75           # a ridge point lies within this of its pixel's centre (0.5, and some for noise)
KINK_PX = 6             # a branch that turns by more than MAX_KINK within this to either side is two lines that touch
MAX_KINK = np.deg2rad(38)


@dataclass(frozen=True)
class Ridges:
    """Sub-pixel ridge points of one image, sorted by branch and along each branch."""

    points_px: np.ndarray   # (M, 2)
    z: np.ndarray           # (M,) strength in standard deviations of the noise
    start: np.ndarray       # (B + 1,) branch b is start[b]:start[b + 1]
    step_px: int = 1        # distance of the points along a ridge


def shrinking(half_width_px: float) -> int:
    """By how much an image may be made smaller, 1, 2 or 4, before lines of this half width are looked for in it."""
    return next((k for k in (4, 2) if half_width_px / k >= NARROWEST_PX
                 and ridge_scale(half_width_px) / k >= FINEST_SIGMA), 1)


def ridge_scale(half_width_px: float) -> float:
    """sigma in px of the smoothing that fits a cylinder's shadow of this half width, blurred by about 0.8 px."""
    return max(1.2, 1.2 * float(np.hypot(0.5 * half_width_px, 0.8)))


def find_ridges(image: np.ndarray, field: np.ndarray, sigma: float, shrink: int = 1) -> Ridges:
    """Ridges of dark lines of scale `sigma` px in an (H, W) float32 image, inside the (H, W) field (Steger 1998).

    `shrink`: looked for in an image so many times smaller; points are still pixels of the image given.
    """
    if shrink > 1:
        size = image.shape[1] // shrink, image.shape[0] // shrink
        image, field = (a[:size[1] * shrink, :size[0] * shrink] for a in (image, field))
        small = _ridges(cv2.resize(image, size, interpolation=cv2.INTER_AREA),
                        cv2.resize(field, size, interpolation=cv2.INTER_NEAREST), sigma / shrink, shrink)
        return Ridges(small.points_px * shrink + (shrink - 1) / 2, small.z, small.start, shrink)
    return _ridges(image, field, sigma, 1)


@lru_cache(64)
def _noise_ratio(sigma: float) -> float:
    """Standard deviation of 2 I_uu over that of 2 I_uv of white noise, smoothed and differentiated as in `_ridges`."""
    smooth = cv2.getGaussianKernel(2 * int(4 * sigma + 1) + 1, sigma).ravel()
    straight, first, second = (np.linalg.norm(np.convolve(smooth, k)) for k in ([1.0], [-0.5, 0, 0.5], [1, -2, 1]))
    return float(straight * second / first**2)


def _ridges(image: np.ndarray, field: np.ndarray, sigma: float, shrink: int) -> Ridges:
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    second, one, first = (np.array(k, np.float32) for k in ([1, -2, 1], [1], [-0.5, 0, 0.5]))
    uu = cv2.sepFilter2D(smooth, cv2.CV_32F, second, one)
    vv = cv2.sepFilter2D(smooth, cv2.CV_32F, one, second)
    uv = cv2.sepFilter2D(smooth, cv2.CV_32F, 2 * first, first)              # 2 I_uv
    l2 = cv2.magnitude(cv2.subtract(uu, vv), uv)
    cv2.add(l2, cv2.add(uu, vv), dst=l2)                                    # 2 l2, the larger eigenvalue of the Hessian
    margin = int(np.ceil(3 * sigma))
    inside = cv2.erode(field, np.ones((2 * margin + 1,) * 2, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    stride = 31 if image.shape[1] % 31 else 29      # no row or column is favoured: a device may lie along one
    some = inside.ravel()[::stride] > 0
    if not some.any():
        return _no_ridges()
    noise = _noise_ratio(sigma) * 1.4826 * float(middle(np.abs(uv.ravel()[::stride][some]))) + 1e-12    # of 2 l2
    sample = l2.ravel()[::stride][some]
    enough = int((1 - min(max(shrink * MAX_RIDGE_SHARE, FEW_RIDGES / (shrink * image.size)), 0.9)) * len(sample))
    # without noise, rounding is no ridge
    faintest = FAINTEST * max(cv2.norm(l2, cv2.NORM_INF), float(smooth.max()) * 1e-3)
    level = max(RIDGE_Z * noise, faintest, float(np.partition(sample, enough)[enough]))
    found = cv2.findNonZero(cv2.bitwise_and(cv2.compare(l2, level, cv2.CMP_GT), inside))
    if found is None:
        return _no_ridges()
    u, v = found.reshape(-1, 2).T.astype(np.int64)      # OpenCV 4 gives (N, 1, 2), OpenCV 5 (N, 2)
    at = v * image.shape[1] + u
    gray, l2, uu, vv, uv = (a.ravel() for a in (smooth, l2, uu, vv, uv))
    strength, i_uu, i_uv, i_vv = 0.5 * l2[at], uu[at], 0.5 * uv[at], vv[at]
    big = np.abs(strength - i_vv) > np.abs(strength - i_uu)
    # eigenvector of l2: across the ridge
    nu, nv = np.where(big, strength - i_vv, i_uv), np.where(big, i_uv, strength - i_uu)
    norm = np.hypot(nu, nv) + 1e-30
    nu, nv = nu / norm, nv / norm
    w = image.shape[1]
    gu, gv = 0.5 * (gray[at + 1] - gray[at - 1]), 0.5 * (gray[at + w] - gray[at - w])
    t = -(gu * nu + gv * nv) / strength
    du, dv = t * nu, t * nv
    keep = np.nonzero((np.abs(du) <= NMS_PX) & (np.abs(dv) <= NMS_PX)
                      & (np.abs(i_uu + i_vv - strength) < 0.7 * strength))[0]
    # a dark line is darker than both its sides; the foot of a bright line or of an edge is not
    side = np.rint(2 * sigma * nv[keep]).astype(int) * w + np.rint(2 * sigma * nu[keep]).astype(int)
    rise = np.stack([gray[at[keep] + side], gray[at[keep] - side]]) - gray[at[keep]]
    keep = keep[rise.min(axis=0) > ONE_SIDED * rise.mean(axis=0)]
    # where two pixels side by side claim the ridge, the nearer one has it
    index = np.full(image.size, -1, np.int32)
    index[at[keep]] = np.arange(len(keep))
    far = np.abs(t[keep])
    beside = at[keep] + np.where(t[keep] > 0, 1, -1) * (np.rint(nv[keep]).astype(int) * w
                                                        + np.rint(nu[keep]).astype(int))
    rival = index[beside]
    gone = (rival >= 0) & ((far > far[rival]) | ((far == far[rival]) & (at[keep] > beside)))
    index[at[keep[gone]]] = -1
    keep = keep[~gone]
    index[at[keep]] = np.arange(len(keep))
    points = np.stack([u[keep] + du[keep], v[keep] + dv[keep]], axis=1)
    return _branches(points, 2 * strength[keep] / noise, _neighbour_pairs(at[keep], index, w),
                     max(KINK_PX // shrink, 3))


def _no_ridges() -> Ridges:
    return Ridges(np.empty((0, 2)), np.empty(0), np.zeros(1, int))


def _branches(points: np.ndarray, z: np.ndarray, pairs: np.ndarray, kink: int) -> Ridges:
    """Cut the (M, 2) ridge points, (E, 2) of which are neighbours, at junctions and sort them along their branches;
    where one turns sharply within `kink` points, two lines touch."""
    alive = np.bincount(pairs.ravel(), minlength=len(z)) <= 2
    pairs = pairs[alive[pairs].all(axis=1)]
    label, place, rings = _walk(pairs, len(z))
    if rings.any():     # a ring has no end to start from: open it at its first pixel
        opened = _walk(pairs[(label[pairs[:, 0]] < 0) & ~rings[pairs].any(axis=1)], len(z))
        label, place = np.maximum(label, opened[0]), np.maximum(place, opened[1])
    order = np.lexsort((place, label))[np.count_nonzero(label < 0):]
    if not len(order):
        return _no_ridges()
    return _split_at_kinks(points[order], z[order], label[order], kink)


def _walk(pairs: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) label and (n,) place of each of n pixels along the open line it is in, -1 where it is in none; and (n,)
    bool: the first pixels of rings.

    pairs: (E, 2) neighbours, at most two a pixel. Each pair is a step either way; from step to step, then from 2nd to
    2nd, 4th to 4th ... until all know where they end (pointer jumping, Wyllie 1979).
    """
    label, place, rings = np.full(n, -1), np.full(n, -1), np.zeros(n, bool)
    if not len(pairs):
        return label, place, rings
    count = len(pairs)
    tail, head = np.concatenate([pairs[:, 0], pairs[:, 1]]), np.concatenate([pairs[:, 1], pairs[:, 0]])
    step = np.arange(2 * count)
    back = np.roll(step, count)
    leaving = np.full((2, n), -1)       # steps that leave each pixel: the first and the last in the list
    leaving[0, tail[::-1]], leaving[1, tail] = step[::-1], step
    one, two = leaving[:, head]
    after = np.where(one != back, one, two)
    last = after == back                # nothing but the way back: the line ends here
    after = np.where(last, step, after)
    steps, lowest = np.where(last, 0, 1), np.minimum(tail, head)
    for _ in range(int(np.ceil(np.log2(count))) + 1):
        steps, lowest, after = steps + steps[after], np.minimum(lowest, lowest[after]), after[after]
        if last[after].all():       # no rings: done when the longest line is
            break
    ring = ~last[after]
    rings[lowest[ring]] = True
    end = head[after]
    towards = ~ring & (end < end[back])     # every line has two ends; steps towards the lower one count places
    label[tail[towards]], place[tail[towards]] = end[towards], steps[towards] + 1
    label[head[towards]], place[head[towards]] = end[towards], steps[towards]
    return label, place, rings


def _split_at_kinks(points: np.ndarray, z: np.ndarray, label: np.ndarray, k: int) -> Ridges:
    """Branches of (M, 2) points sorted by their (M,) label, cut where one turns by MAX_KINK within `k` points."""
    sharp = np.zeros(len(label), bool)
    if len(label) > 2 * k:
        step = points[k:] - points[:-k]
        square = np.einsum('ij,ij->i', step, step)
        cosine = np.einsum('ij,ij->i', step[:-k], step[k:]) / np.sqrt(square[:-k] * square[k:] + 1e-18)
        turn = (label[:-2 * k] == label[2 * k:]) & (cosine < np.cos(MAX_KINK))
        sharp[k:-k] = turn
        sharp[k - 1:-k - 1] |= turn
        sharp[k + 1:len(label) - k + 1] |= turn
    cut = np.zeros(len(label), bool)
    cut[1:] = (label[1:] != label[:-1]) | (sharp[1:] != sharp[:-1])
    piece, keep = np.cumsum(cut), ~sharp
    points, z, piece = points[keep], z[keep], piece[keep]
    changes = np.nonzero(np.diff(piece))[0] + 1
    return Ridges(points, z, np.concatenate([[0], changes, [len(z)]]).astype(int))


def _neighbour_pairs(at: np.ndarray, index: np.ndarray, w: int) -> np.ndarray:
    """(E, 2) 8-neighbours among pixels; a diagonal only where no 4-neighbour path joins the two.

    at: (M,) places in the raveled image, not at its border. index: (H * W,) which pixel is there, -1 for none. w: the
    image's width.
    """
    here = np.arange(len(at), dtype=index.dtype)
    right, left, down = index[at + 1] >= 0, index[at - 1] >= 0, index[at + w] >= 0
    pairs = []
    for step, ok in ((1, right), (w, down), (w + 1, ~(right | down)), (w - 1, ~(left | down))):
        other = index[at + step]
        ok = ok & (other >= 0)
        pairs.append(np.stack([here[ok], other[ok]], axis=1))
    return np.concatenate(pairs)
