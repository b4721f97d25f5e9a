"""From an image to device candidates: ridge points, branches, and chains of branches that continue one another."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

RIDGE_Z = 3.5           # ridge points stand out from the noise by this many standard deviations ...
BRANCH_Z = 5.0          # ... and branches by this, on average over their best half
MAX_RIDGE_SHARE = 0.015 # of the pixels, at most: the strongest
FEW_RIDGES = 16000      # pixels that are never too many
FAINTEST = 0.01         # of the strongest ridge
ONE_SIDED = 0.15        # the side that is less bright rises at least this much of the mean
NMS_PX = 0.75           # a ridge point lies within this of its pixel's centre (0.5, and some for noise)
KINK_PX = 6             # a branch that turns by more than this within so many points to either side is two lines that touch
MAX_KINK = np.deg2rad(38)
END_PX = 12             # length over which the direction of a branch's end is measured
GAP_PX = 48.0           # longest gap that is bridged, where it is straight
MAX_TURN = np.deg2rad(50)    # ... the direction may change by this over a short gap


@dataclass(frozen=True)
class Ridges:
    """Sub-pixel ridge points of one image, sorted by branch and along each branch."""

    points_px: np.ndarray   # (M, 2)
    z: np.ndarray           # (M,) strength in standard deviations of the noise
    start: np.ndarray       # (B + 1,) branch b is start[b]:start[b + 1]


def ridge_scale(half_width_px: float) -> float:
    """sigma in px of the smoothing that fits a cylinder's shadow of this half width, blurred by about 0.8 px."""
    return max(1.2, 1.2 * float(np.hypot(0.5 * half_width_px, 0.8)))


def find_ridges(image: np.ndarray, field: np.ndarray, sigma: float) -> Ridges:
    """Ridges of dark lines of scale `sigma` px in an (H, W) float32 image, inside the (H, W) field (Steger 1998)."""
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    second, one, first = np.float32([1, -2, 1]), np.float32([1]), np.float32([-0.5, 0, 0.5])
    uu = cv2.sepFilter2D(smooth, cv2.CV_32F, second, one)
    vv = cv2.sepFilter2D(smooth, cv2.CV_32F, one, second)
    uv = cv2.sepFilter2D(smooth, cv2.CV_32F, 2 * first, first)              # 2 I_uv
    l2 = cv2.magnitude(cv2.subtract(uu, vv), uv)
    cv2.add(l2, cv2.add(uu, vv), dst=l2)                                    # 2 l2, the larger eigenvalue of the Hessian
    margin = int(3 * sigma)
    inside = cv2.erode(field, np.ones((2 * margin + 1,) * 2, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    stride = 31 if image.shape[1] % 31 else 29      # no row or column is favoured: a device may lie along one
    some = inside.ravel()[::stride] > 0
    if not some.any():
        return _no_ridges()
    noise = np.sqrt(3) * 1.4826 * float(np.median(np.abs(uv.ravel()[::stride][some]))) + 1e-12  # white noise: Var(uu) = 3 Var(uv); of 2 l2
    sample = l2.ravel()[::stride][some]
    enough = int((1 - min(max(MAX_RIDGE_SHARE, FEW_RIDGES / image.size), 0.9)) * len(sample))
    faintest = FAINTEST * max(cv2.norm(l2, cv2.NORM_INF), float(smooth.max()) * 1e-3)           # without noise, rounding is no ridge
    level = max(RIDGE_Z * noise, faintest, float(np.partition(sample, enough)[enough]))
    found = cv2.findNonZero(cv2.bitwise_and(cv2.compare(l2, level, cv2.CMP_GT), inside))
    if found is None:
        return _no_ridges()
    u, v = found.reshape(-1, 2).T.astype(np.int64)      # OpenCV 4 gives (N, 1, 2), OpenCV 5 (N, 2)
    at = v * image.shape[1] + u
    gray, l2, uu, vv, uv = (a.ravel() for a in (smooth, l2, uu, vv, uv))
    strength, i_uu, i_uv, i_vv = 0.5 * l2[at], uu[at], 0.5 * uv[at], vv[at]
    big = np.abs(strength - i_vv) > np.abs(strength - i_uu)
    nu, nv = np.where(big, strength - i_vv, i_uv), np.where(big, i_uv, strength - i_uu)     # eigenvector of l2: across the ridge
    norm = np.hypot(nu, nv) + 1e-30
    nu, nv = nu / norm, nv / norm
    w = image.shape[1]
    gu, gv = 0.5 * (gray[at + 1] - gray[at - 1]), 0.5 * (gray[at + w] - gray[at - w])
    t = -(gu * nu + gv * nv) / strength
    du, dv = t * nu, t * nv
    keep = np.nonzero((np.abs(du) <= NMS_PX) & (np.abs(dv) <= NMS_PX) & (np.abs(i_uu + i_vv - strength) < 0.7 * strength))[0]
    # a dark line is darker than both its sides; the foot of a bright line or of an edge is not
    side = np.rint(2 * sigma * nv[keep]).astype(int) * w + np.rint(2 * sigma * nu[keep]).astype(int)
    rise = np.stack([gray[at[keep] + side], gray[at[keep] - side]]) - gray[at[keep]]
    keep = keep[rise.min(axis=0) > ONE_SIDED * rise.mean(axis=0)]
    # where two pixels side by side claim the ridge, the nearer one has it
    index = np.full(image.size, -1, np.int32)
    index[at[keep]] = np.arange(len(keep))
    far = np.abs(t[keep])
    beside = at[keep] + np.where(t[keep] > 0, 1, -1) * (np.rint(nv[keep]).astype(int) * w + np.rint(nu[keep]).astype(int))
    rival = index[beside]
    keep = keep[(rival < 0) | (far < far[rival]) | ((far == far[rival]) & (at[keep] < beside))]
    u, v = u[keep], v[keep]
    return _branches(u, v, u + du[keep], v + dv[keep], 2 * strength[keep] / noise, image.shape)


def _no_ridges() -> Ridges:
    return Ridges(np.empty((0, 2)), np.empty(0), np.zeros(1, int))


def _branches(u, v, su, sv, z, shape) -> Ridges:
    """Cut the ridge pixels at junctions and sort them along their branches."""
    pairs = _neighbour_pairs(u, v, shape)
    degree = np.bincount(pairs.ravel(), minlength=len(u))
    alive = degree <= 2
    pairs = pairs[alive[pairs].all(axis=1)]
    # closed loops have no end to start from: open them at their first pixel
    degree = np.bincount(pairs.ravel(), minlength=len(u))
    count, label = connected_components(_graph(pairs, len(u)), directed=False)
    has_end = np.zeros(count, bool)
    has_end[label[degree <= 1]] = True
    _, first = np.unique(label, return_index=True)
    alive[first[~has_end]] = False
    pairs = pairs[alive[pairs].all(axis=1)]
    degree = np.bincount(pairs.ravel(), minlength=len(u))
    graph = _graph(pairs, len(u))
    count, label = connected_components(graph, directed=False)
    ends = np.nonzero(degree <= 1)[0]
    _, k = np.unique(label[ends], return_index=True)
    along = dijkstra(graph, directed=False, indices=ends[k], min_only=True)
    order = np.lexsort((along, label))
    order = order[alive[order]]
    if not len(order):
        return _no_ridges()
    return _split_at_kinks(np.c_[su, sv][order], z[order], label[order])


def _split_at_kinks(points: np.ndarray, z: np.ndarray, label: np.ndarray) -> Ridges:
    """Branches of (M, 2) points sorted by their (M,) label; where one turns sharply, two lines touch, and it is cut."""
    k = KINK_PX
    turn = np.zeros(len(label))
    if len(label) > 2 * k:
        before, after = points[k:-k] - points[:-2 * k], points[2 * k:] - points[k:-k]
        cosine = (before * after).sum(axis=1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1) + 1e-9)
        turn[k:-k] = np.where(label[:-2 * k] == label[2 * k:], np.arccos(np.clip(cosine, -1, 1)), 0)
    sharp = maximum_filter1d((turn > MAX_KINK).astype(np.uint8), 3) > 0
    cut = np.diff(label, prepend=label[0]) != 0
    cut |= np.diff(sharp.astype(np.int8), prepend=0) != 0
    piece, keep = np.cumsum(cut), ~sharp
    points, z, piece = points[keep], z[keep], piece[keep]
    changes = np.nonzero(np.diff(piece))[0] + 1
    return Ridges(points, z, np.concatenate([[0], changes, [len(z)]]).astype(int))


def _neighbour_pairs(u: np.ndarray, v: np.ndarray, shape) -> np.ndarray:
    """(E, 2) indices of 8-neighbours among the pixels; a diagonal only where no 4-neighbour path joins the two."""
    w = shape[1] + 2
    index = np.full(w * (shape[0] + 2), -1, np.int32)
    at = (v + 1) * w + u + 1
    here = np.arange(len(u), dtype=np.int32)
    index[at] = here
    right, down = index[at + 1], index[at + w]
    pairs = [np.c_[here, right][right >= 0], np.c_[here, down][down >= 0]]
    for step, corner_1, corner_2 in ((w + 1, 1, w), (w - 1, -1, w)):
        other = index[at + step]
        ok = (other >= 0) & (index[at + corner_1] < 0) & (index[at + corner_2] < 0)
        pairs.append(np.c_[here, other][ok])
    return np.concatenate(pairs)


def _graph(pairs: np.ndarray, n: int):
    return coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsr()


@dataclass(frozen=True)
class Candidate:
    """A chain of branches that may be the device."""

    points_px: np.ndarray   # (N, 2) sub-pixel, gaps filled with straight lines, about a pixel apart
    z: np.ndarray           # (N,) ridge strength; 0 in gaps
    score: float            # how much of a device it looks like: strength times length


def find_candidates(ridges: Ridges, min_length_px: float, count: int = 8) -> list[Candidate]:
    """The `count` best chains of an image, best first."""
    branches = _strong_branches(ridges)
    if not branches:
        return []
    partner = _link_ends(branches)
    chains = [_join(branches, chain) for chain in _follow(partner, len(branches))]
    candidates = [c for c in chains if np.linalg.norm(np.diff(c.points_px, axis=0), axis=1).sum() >= min_length_px]
    return sorted(candidates, key=lambda c: -c.score)[:count]


def _strong_branches(ridges: Ridges) -> list[tuple[np.ndarray, np.ndarray]]:
    """(points, z) of the branches that are no noise: long and strong enough together."""
    length = np.diff(ridges.start)
    if not len(ridges.z):
        return []
    mean = np.add.reduceat(ridges.z, ridges.start[:-1]) / length
    excess = (mean - RIDGE_Z) * np.sqrt(length)
    good = np.nonzero((length >= 5) & (mean > BRANCH_Z) & (excess > 8.0))[0]
    good = good[np.argsort(-(mean * length)[good])][:90]
    return [(ridges.points_px[ridges.start[b]:ridges.start[b + 1]], ridges.z[ridges.start[b]:ridges.start[b + 1]]) for b in good]


def _link_ends(branches) -> np.ndarray:
    """(2 B,) for each branch end (2 b: first, 2 b + 1: last) the end it continues in, or -1: best continuations first, each end once."""
    ends, out, strength = [], [], []
    for points, z in branches:
        n = min(END_PX, len(points))
        for e in (points[:n], points[::-1][:n]):
            d = e[0] - e[-1]
            ends.append(e[0])
            out.append(d / (np.linalg.norm(d) + 1e-9))
        strength += [z.mean()] * 2
    ends, out, strength = np.array(ends), np.array(out), np.array(strength)
    gap = ends[None] - ends[:, None]                                    # from i to j
    d = np.linalg.norm(gap, axis=2)
    slack = 1.5 / np.maximum(d, 1.5)                                    # direction of a short gap is uncertain
    along = gap / np.maximum(d, 1e-9)[..., None]
    turn_i = np.arccos(np.clip(np.einsum('ijk,ik->ij', along, out), -1, 1))
    turn_j = np.arccos(np.clip(-np.einsum('ijk,jk->ij', along, out), -1, 1))
    between = np.arccos(np.clip(-out @ out.T, -1, 1))
    turn = np.maximum(between, np.maximum(turn_i, turn_j) - np.arcsin(np.clip(slack, 0, 1)))
    ratio = np.abs(np.log(strength[:, None] / strength))
    cost = d / GAP_PX + (turn / MAX_TURN) ** 2 + 0.5 * ratio
    own = np.arange(len(ends)) // 2
    cost[(own[:, None] == own) | (d > GAP_PX) | (turn > MAX_TURN * (1 - 0.6 * d / GAP_PX)) | (ratio > 1.5)] = np.inf
    partner = np.full(len(ends), -1)
    i, j = np.nonzero(np.triu(np.isfinite(cost)))
    for k in np.argsort(cost[i, j]):
        if partner[i[k]] < 0 and partner[j[k]] < 0:
            partner[i[k]], partner[j[k]] = j[k], i[k]
    return partner


def _follow(partner: np.ndarray, count: int) -> list[list[int]]:
    """Chains of branch ends: each entry is the end at which a branch is entered."""
    used, chains = np.zeros(count, bool), []
    free = [e for e in range(2 * count) if partner[e] < 0] + list(range(2 * count))     # open chains first, then rings
    for entry in free:
        chain = []
        while entry >= 0 and not used[entry // 2]:
            used[entry // 2] = True
            chain.append(entry)
            entry = partner[entry ^ 1]
        if chain:
            chains.append(chain)
    return chains


def _join(branches, chain: list[int]) -> Candidate:
    points, z = [], []
    for entry in chain:
        p, q = branches[entry // 2]
        if entry % 2:
            p, q = p[::-1], q[::-1]
        if points:
            n = int(np.linalg.norm(p[0] - points[-1][-1]))
            points.append(np.linspace(points[-1][-1], p[0], n + 1)[1:-1].reshape(-1, 2) if n > 1 else p[:0])
            z.append(np.zeros(len(points[-1])))
        points.append(p)
        z.append(q)
    points, z = np.concatenate(points), np.concatenate(z)
    return Candidate(points, z, float(z.sum()))
