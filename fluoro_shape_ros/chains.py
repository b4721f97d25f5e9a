"""From the branches of one image to device candidates: chains of branches that continue one another, across crossings and gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .centerline import RIDGE_Z, Ridges
from .curve import arc_length

BRANCH_Z = 5.0          # standard deviations of the noise by which a branch stands out on average
END_PX = 12             # length over which the direction of a branch's end is measured
BRANCHES = 90           # strongest ones of an image that are linked
GAP_PX = 48.0           # longest gap that is bridged, where it is straight ...
MAX_TURN = np.deg2rad(50)    # ... the direction may change by this over a short gap


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
    chains = _follow(_link_ends(branches, ridges.step_px), len(branches))
    strength = [sum(branches[entry // 2][1].sum() for entry in chain) for chain in chains]
    candidates = []
    for k in np.argsort(-np.array(strength)):
        line = _join(branches, chains[k], ridges.step_px)
        if arc_length(line.points_px)[-1] >= min_length_px:
            candidates.append(line)
        if len(candidates) == count:
            break
    return candidates


def _strong_branches(ridges: Ridges) -> list[tuple[np.ndarray, np.ndarray]]:
    """(points, z) of the branches that are no noise: long and strong enough together."""
    length = np.diff(ridges.start)
    if not len(ridges.z):
        return []
    mean = np.add.reduceat(ridges.z, ridges.start[:-1]) / length
    excess = (mean - RIDGE_Z) * np.sqrt(length * ridges.step_px)
    good = np.nonzero((length >= max(5 // ridges.step_px, 3)) & (mean > BRANCH_Z) & (excess > 8.0))[0]
    good = good[np.argsort(-(mean * length)[good])][:BRANCHES]
    return [(ridges.points_px[ridges.start[b]:ridges.start[b + 1]], ridges.z[ridges.start[b]:ridges.start[b + 1]]) for b in good]


def _link_ends(branches, step_px: int) -> np.ndarray:
    """(2 B,) for each branch end (2 b: first, 2 b + 1: last) the end it continues in, or -1: best continuations first, each end once."""
    inner = [min(END_PX // step_px, len(p)) - 1 for p, _ in branches]
    ends = np.array([e for p, _ in branches for e in (p[0], p[-1])])
    out = ends - np.array([e for (p, _), n in zip(branches, inner) for e in (p[n], p[-1 - n])])
    out /= np.linalg.norm(out, axis=1, keepdims=True) + 1e-9
    strength = np.repeat([z.mean() for _, z in branches], 2)
    i, j = cKDTree(ends).query_pairs(GAP_PX, output_type='ndarray').T
    i, j = (x[i // 2 != j // 2] for x in (i, j))
    gap = ends[j] - ends[i]
    d = np.linalg.norm(gap, axis=1)
    slack = 1.5 * step_px / np.maximum(d, 1.5 * step_px)                    # direction of a short gap is uncertain
    along = gap / np.maximum(d, 1e-9)[:, None]
    turn_i, turn_j, between = (np.arccos(np.clip((a * b).sum(axis=1), -1, 1)) for a, b in ((along, out[i]), (-along, out[j]), (-out[i], out[j])))
    turn = np.maximum(between, np.maximum(turn_i, turn_j) - np.arcsin(slack))
    ratio = np.abs(np.log(strength[i] / strength[j]))
    cost = d / GAP_PX + (turn / MAX_TURN) ** 2 + 0.5 * ratio
    partner = np.full(len(ends), -1)
    for k in np.argsort(cost, kind='stable'):
        if turn[k] <= MAX_TURN * (1 - 0.6 * d[k] / GAP_PX) and ratio[k] <= 1.5 and partner[i[k]] < 0 and partner[j[k]] < 0:
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


def _join(branches, chain: list[int], step_px: int) -> Candidate:
    """One line from the branches of a chain, a point about every px."""
    points, z = [], []
    for entry in chain:
        p, q = branches[entry // 2]
        if entry % 2:
            p, q = p[::-1], q[::-1]
        if points:
            n = int(np.hypot(*(p[0] - points[-1][-1])) / step_px)
            points.append(np.linspace(points[-1][-1], p[0], n + 1)[1:-1].reshape(-1, 2) if n > 1 else p[:0])
            z.append(np.zeros(len(points[-1])))
        points.append(p)
        z.append(q)
    points, z = np.concatenate(points), np.concatenate(z)
    if step_px > 1:
        at = np.linspace(0, len(z) - 1, step_px * (len(z) - 1) + 1)
        points, z = np.stack([np.interp(at, np.arange(len(z)), x) for x in points.T], axis=1), z[np.round(at).astype(int)]
    return Candidate(points, z, float(z.sum()))
