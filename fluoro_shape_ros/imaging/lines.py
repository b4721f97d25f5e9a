"""From the branches of one image to device candidates: chains of branches that continue one another, across crossings
and gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .ridges import RIDGE_Z, Ridges

BRANCH_Z = 5.0          # standard deviations of the noise by which a branch stands out on average
END_PX = 12             # length over which the direction of a branch's end is measured
BRANCHES = 90           # strongest ones of an image that are linked
GAP_PX = 48.0           # longest gap that is bridged, where it is straight ...
MAX_TURN = np.deg2rad(50)    # ... the direction may change by this over a short gap


@dataclass(frozen=True, eq=False)
class Candidate:
    """A chain of branches that may be the device."""

    points_px: np.ndarray   # (N, 2) sub-pixel, gaps filled with straight lines, about a pixel apart
    z: np.ndarray           # (N,) ridge strength; 0 in gaps
    score: float            # how much of a device it looks like: strength times length


def find_candidates(ridges: Ridges, min_length_px: float, count: int = 8, gap_px: float = GAP_PX) -> list[Candidate]:
    """The `count` best chains of an image, best first. gap_px: the longest gap that is bridged."""
    start, stop, strength = _strong_branches(ridges)
    if not len(start):
        return []
    chains = _follow(_link_ends(ridges, start, stop, strength, gap_px), len(start))
    total = strength * (stop - start)
    chains.sort(key=lambda chain: -sum(total[entry // 2] for entry in chain))
    return _joined(ridges, start, stop, chains, min_length_px, count)


def _strong_branches(ridges: Ridges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(B,) first point, (B,) the one past the last and (B,) mean strength of the branches that are no noise: long and
    strong enough together."""
    length = np.diff(ridges.start)
    if not len(ridges.z):
        return length, length, length
    mean = np.add.reduceat(ridges.z, ridges.start[:-1]) / length
    excess = (mean - RIDGE_Z) * np.sqrt(length * ridges.step_px)
    good = np.nonzero((length >= max(5 // ridges.step_px, 3)) & (mean > BRANCH_Z) & (excess > 8.0))[0]
    good = good[np.argsort(-(mean * length)[good])][:BRANCHES]
    return ridges.start[good], ridges.start[good + 1], mean[good]


def _link_ends(ridges: Ridges, start: np.ndarray, stop: np.ndarray, strength: np.ndarray,
               gap_px: float) -> np.ndarray:
    """(2 B,) for each branch end (2 b: first, 2 b + 1: last) the end it continues in, or -1: best continuations first,
    each end once."""
    step_px = ridges.step_px
    inner = np.minimum(END_PX // step_px, stop - start - 1)
    ends = ridges.points_px[np.stack([start, stop - 1], axis=1).ravel()]
    out = ends - ridges.points_px[np.stack([start + inner, stop - 1 - inner], axis=1).ravel()]
    out /= np.linalg.norm(out, axis=1, keepdims=True) + 1e-9
    strength = np.repeat(strength, 2)
    gap = ends - ends[:, None]                                              # from the first index to the second
    d = np.hypot(gap[..., 0], gap[..., 1])
    i, j = np.nonzero(np.triu(d < gap_px, 1))
    i, j = (x[i // 2 != j // 2] for x in (i, j))
    gap, d = gap[i, j], d[i, j]
    slack = 1.5 * step_px / np.maximum(d, 1.5 * step_px)                    # direction of a short gap is uncertain
    along = gap / np.maximum(d, 1e-9)[:, None]
    turn_i, turn_j, between = (np.arccos(np.clip((a * b).sum(axis=1), -1, 1))
                               for a, b in ((along, out[i]), (-along, out[j]), (-out[i], out[j])))
    turn = np.maximum(between, np.maximum(turn_i, turn_j) - np.arcsin(slack))
    ratio = np.abs(np.log(strength[i] / strength[j]))
    cost = d / gap_px + (turn / MAX_TURN) ** 2 + 0.5 * ratio
    allowed = np.nonzero((turn <= MAX_TURN * (1 - 0.6 * d / gap_px)) & (ratio <= 1.5))[0]
    partner = np.full(len(ends), -1)
    for k in allowed[np.argsort(cost[allowed], kind='stable')]:
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


def _joined(ridges: Ridges, start: np.ndarray, stop: np.ndarray, chains: list[list[int]], min_length_px: float,
            count: int) -> list[Candidate]:
    """One line from the branches of each chain, a point about every px; of those that are long enough the first
    `count`.

    chains: for each the ends at which its branches are entered.
    """
    entries = [entry for chain in chains for entry in chain]
    at = np.concatenate([np.arange(start[e // 2], stop[e // 2])[::-1 if e % 2 else 1] for e in entries])
    sizes = (stop - start)[np.array(entries) // 2]
    of = np.repeat(np.repeat(np.arange(len(chains)), [len(chain) for chain in chains]), sizes)
    points, z = ridges.points_px[at], ridges.z[at]
    length = np.hypot(*np.diff(points, axis=0).T)
    last = np.cumsum(sizes)[:-1] - 1        # of each branch but the very last: what follows is a gap, or another chain
    step = np.full(len(length), ridges.step_px)
    step[last] = np.ceil(length[last])
    gap = np.zeros(len(z), bool)
    gap[last] = length[last] >= 2 * ridges.step_px
    length[of[1:] != of[:-1]] = 0.0
    enough = np.nonzero(np.bincount(of[1:], length, len(chains)) >= min_length_px)[0][:count]
    t = np.concatenate([[0], np.cumsum(np.maximum(step, 1))])       # about px from the first point of all
    candidates = []
    for k in enough:
        i, j = np.searchsorted(of, [k, k + 1])
        px = np.arange(t[i], t[j - 1] + 1)
        before = np.searchsorted(t[i:j], px, side='right') - 1 + i
        hidden = gap[before] & (px > t[before])
        line = np.stack([np.interp(px, t[i:j], x) for x in points[i:j].T], axis=1)
        candidates.append(Candidate(line, np.where(hidden, 0.0, z[before]), float(z[i:j].sum())))
    return candidates
