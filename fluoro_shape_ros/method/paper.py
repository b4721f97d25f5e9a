"""The published method, step by step: J. Burgner, S. D. Herrell, R. J. Webster III, "Toward Fluoroscopic Shape
Reconstruction for Control of Steerable Medical Devices", ASME DSCC 2011.

What the paper leaves open is marked "open:". It is kept literal so that everything later can be compared with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from ..config import Config
from ..data import View
from ..geometry.cameras import epipolar_lines, fundamental, isocenter, pixels_per_metre, triangulate, undistort
from ..geometry.curve import arc_length, at_arc_length
from ..imaging.hessian import eigenvalues, hessian

WIENER_PX = 6
BETA_1 = 2 * 0.8**2
SCALES = (1.0, 1.5, 2.0)    # open: "several", here in half widths of the device
STAIRCASE_PX = 5
END_PX = 5.0


def segment(image: np.ndarray, half_width_px: float, min_length_px: float) -> np.ndarray:
    """(N, 2) centreline in px of the largest curve in the (H, W) image of a dark device, or (0, 2) where there is
    none."""
    # here: the node's default method needs no scikit-image, and starts faster without
    from skimage.morphology import thin
    image = image.astype(np.float32)
    filtered = vesselness(wiener(image), [max(1.0, half_width_px * k) for k in SCALES])
    binary = filtered > filtered.mean()             # "thresholded by the mean intensity"
    return longest_curve(thin(binary), min_length_px)


def wiener(image: np.ndarray) -> np.ndarray:
    """Pixel-wise adaptive Wiener filter over a 6x6 neighbourhood; the noise power is the mean of the local variances
    (Lim 1990, as in Matlab's wiener2)."""
    box = (WIENER_PX, WIENER_PX)
    mean = cv2.boxFilter(image, cv2.CV_32F, box, borderType=cv2.BORDER_REFLECT)
    variance = np.maximum(cv2.boxFilter(image * image, cv2.CV_32F, box, borderType=cv2.BORDER_REFLECT) - mean * mean, 0)
    noise = float(variance.mean())
    gain = np.maximum(variance - noise, 0) / np.maximum(np.maximum(variance, noise), 1e-12)
    return mean + gain * (image - mean)


def vesselness(image: np.ndarray, scales_px: list[float]) -> np.ndarray:
    """Eq. 1 and 2: the response of the continuum robot filter, the largest over the scales; (H, W) in [0, 1]."""
    beta_2 = 2 * (max(float(image.max()), 1e-12) / 4) ** 2
    best = np.zeros_like(image)
    for sigma in scales_px:
        l1, l2 = eigenvalues(*(sigma**2 * h for h in hessian(image, sigma)))    # scale-normalised (Lindeberg)
        R = l1 / np.where(l2 == 0, 1, l2)                       # eq. 1: roundness
        S = l1**2 + l2**2                                       # eq. 1: structureness
        v = np.exp(-(R**2) / BETA_1) * (1 - np.exp(-S / beta_2))    # eq. 2
        best = np.maximum(best, np.where(l2 < 0, 0, v))
    return best


def longest_curve(skeleton: np.ndarray, min_length_px: float) -> np.ndarray:
    """(N, 2) pixels along the largest connected skeleton from end to end; (0, 2) when all have fewer than
    `min_length_px` pixels.

    open: the paper does not say how branches are left out; here the longest shortest path counts.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(skeleton.astype(np.uint8), connectivity=8)
    if count < 2 or stats[1:, cv2.CC_STAT_AREA].max() < min_length_px:
        return np.empty((0, 2))
    v, u = np.nonzero(labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    graph = _neighbours(u, v, labels.shape)
    start = int(np.argmax(np.where(np.isinf(d := dijkstra(graph, indices=0)), -1, d)))
    d, before = dijkstra(graph, indices=start, return_predecessors=True)
    path = [int(np.argmax(np.where(np.isinf(d), -1, d)))]
    while path[-1] != start:
        path.append(before[path[-1]])
    return _without_staircase(np.c_[u[path], v[path]].astype(float))


def _without_staircase(path_px: np.ndarray) -> np.ndarray:
    """open: thinning leaves whole pixels; their mean over STAIRCASE_PX of them is taken for the line, the ends stay."""
    smooth = uniform_filter1d(path_px, STAIRCASE_PX, axis=0, mode='nearest')
    smooth[[0, -1]] = path_px[[0, -1]]
    return smooth


def _neighbours(u: np.ndarray, v: np.ndarray, shape: tuple[int, int]) -> coo_matrix:
    """Graph of the 8-neighbours among pixels (u, v), weighted with their distance."""
    index = np.full((shape[0] + 2, shape[1] + 2), -1)
    index[v + 1, u + 1] = np.arange(len(u))
    rows, cols, weights = [], [], []
    for du, dv in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        other = index[v + 1 + dv, u + 1 + du]
        here = np.nonzero(other >= 0)[0]
        rows += [here, other[here]]
        cols += [other[here], here]
        weights += [np.full(2 * len(here), np.hypot(du, dv))]
    return coo_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(cols))),
                      shape=(len(u), len(u))).tocsr()


def control_points(centerline_px: np.ndarray, spacing_px: float) -> np.ndarray:
    """(N, 2) evenly distributed points along the centreline, both ends among them."""
    length = arc_length(centerline_px)[-1]
    return at_arc_length(centerline_px, np.linspace(0, length, max(int(round(length / spacing_px)), 1) + 1))


def correspond(points_px: np.ndarray, curve_px: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M,) indices of the points whose epipolar line meets the other image's curve, and (M, 2) where.

    points_px: (N, 2), curve_px: (K, 2), both along the device in the same direction; F maps the points' image to the
    curve's.
    open: of several intersections the one at the most similar share of the length counts; an end whose line passes the
    other curve's end within END_PX corresponds to it.
    """
    lines = epipolar_lines(F, points_px)
    distance = lines[:, :2] @ curve_px.T + lines[:, 2:]                 # (N, K) px
    crosses = distance[:, :-1] * distance[:, 1:] <= 0
    share = arc_length(points_px) / arc_length(points_px)[-1]
    along = arc_length(curve_px) / arc_length(curve_px)[-1]
    cost = np.where(crosses, np.abs(along[:-1] - share[:, None]), np.inf)
    met = np.nonzero(np.isfinite(cost.min(axis=1)))[0]
    k = cost[met].argmin(axis=1)
    d0, d1 = distance[met, k], distance[met, k + 1]
    t = np.where(d0 == d1, 0.0, d0 / np.where(d0 == d1, 1.0, d0 - d1))
    there = curve_px[k] + t[:, None] * (curve_px[k + 1] - curve_px[k])
    if 0 not in met and abs(distance[0, 0]) < END_PX:
        met, there = np.append(0, met), np.vstack([curve_px[:1], there])
    if len(points_px) - 1 not in met and abs(distance[-1, -1]) < END_PX:
        met, there = np.append(met, len(points_px) - 1), np.vstack([there, curve_px[-1:]])
    return met, there


def same_direction(a_px: np.ndarray, b_px: np.ndarray, F: np.ndarray) -> bool:
    """Whether two centrelines run the same way: the ends that correspond lie nearer to each other's epipolar lines."""
    d = np.abs(epipolar_lines(F, a_px[[0, -1]]) @ np.c_[b_px[[0, -1]], [1, 1]].T)
    return bool(d[0, 0] + d[1, 1] <= d[0, 1] + d[1, 0])


def reconstruct_curves(views: Sequence[View], centerlines_px: tuple[np.ndarray, np.ndarray],
                       spacing_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The two estimates of the space curve, from plane A's control points and from plane B's: (N, 3) and (M, 3) in m,
    same direction."""
    a, b = (undistort(v, c) for v, c in zip(views, centerlines_px))
    Pa, Pb = (v.P for v in views)
    F = fundamental(Pa, Pb)
    if not same_direction(a, b, F):
        b = b[::-1]
    from_a, from_b = control_points(a, spacing_px), control_points(b, spacing_px)
    i, in_b = correspond(from_a, b, F)
    j, in_a = correspond(from_b, a, F.T)
    return triangulate(Pa, Pb, from_a[i], in_b), triangulate(Pa, Pb, in_a, from_b[j])


def half_width_px(views: Sequence[View], config: Config) -> list[float]:
    """The device's half width in each image, at the isocentre."""
    center = isocenter(views)[None]
    return [config.radius * pixels_per_metre(v.P, center) for v in views]
