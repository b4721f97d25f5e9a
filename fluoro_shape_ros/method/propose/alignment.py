"""Which candidate of plane A and which of plane B are the same device, and which of their points correspond.

A local alignment (Smith and Waterman 1981) of the two curves' points: going along both at once, each point that lies on
the other's epipolar line gains its length, each that does not costs. It is monotone, skips what only one plane sees,
leaves the ends free, and needs no unique intersection, so tangency to an epipolar line and self-crossings do not break
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from heapq import heappop, heappush
from itertools import count

import numpy as np

from ...geometry.cameras import epipolar_lines
from ...geometry.curve import arc_length, at_arc_length

SAMPLES = 64            # points a curve in the alignment
TOLERANCE_PX = 3.0      # epipolar distance at which a point gains nothing
WORST = -1.5            # the most a point costs, in lengths
PAIRS = 24              # of curves that are looked at together
SHORTEST_PX = 60.0      # of both curves together


@dataclass(frozen=True)
class Alignment:
    """Two curves that correspond; arc lengths in px along curve A and curve B, both increasing."""

    a: int                  # index of the candidate in plane A
    b: int                  # and in plane B
    flipped: bool           # B is to be read from its last point to its first
    score: float            # root of the matched length of both (px), times the square of its share, times the weights
    along_a: np.ndarray     # (K,) px
    along_b: np.ndarray     # (K,) px; from the last point when flipped


def align(curves_a: list[np.ndarray], curves_b: list[np.ndarray], weights: list[np.ndarray], F: np.ndarray,
          best: int = 4) -> Iterator[Alignment]:
    """The `best` alignments among all pairs of (N, 2) undistorted curves, best first; F maps A to B. `weights`: how
    much each curve of A and of B counts. None where nothing fits.

    Pairs are looked at in the order of the most that they could score, and no more of them than are asked for.
    """
    if not curves_a or not curves_b:
        return
    a, length_a = _sampled(curves_a)
    b, length_b = _sampled(curves_b)
    # all of both curves matched, the first samples, too
    most = ((SAMPLES / (SAMPLES - 1))**2.5 * np.sqrt(length_a[:, None] + length_b)
            * weights[0][:, None] * weights[1])
    pairs = np.stack(np.unravel_index(np.argsort(-most, axis=None), most.shape), axis=1)
    found: list[tuple[float, int, Callable[[], Alignment | None]]] = []     # a heap
    number = count()
    for k in range(0, len(pairs), PAIRS):
        ia, ib = pairs[k:k + PAIRS].T
        for score, made in _scored(a[ia], b[ib], length_a[ia], length_b[ib], weights[0][ia] * weights[1][ib], F,
                                   pairs[k:k + PAIRS]):
            heappush(found, (-score, next(number), made))
        more = pairs[k + PAIRS:k + PAIRS + 1]
        while found and best and (not len(more) or -found[0][0] >= most[tuple(more[0])]):
            best -= 1
            alignment = heappop(found)[2]()
            if alignment is not None:
                yield alignment
        if not best:
            return


def _scored(a: np.ndarray, b: np.ndarray, length_a: np.ndarray, length_b: np.ndarray, weights: np.ndarray,
            F: np.ndarray, pairs: np.ndarray) -> Iterator[tuple[float, Callable[[], Alignment | None]]]:
    """The score of each of P `pairs` (P, 2) of (P, SAMPLES, 2) curves, either way round, and what traces its alignment;
    None where that is too short."""
    lines, back = (epipolar_lines(M, x.reshape(-1, 2)).reshape(len(x), SAMPLES, 3) for M, x in ((F, a), (F.T, b)))
    to_b = lines[..., :2] @ b.transpose(0, 2, 1) + lines[..., 2:]                               # (P, S, S)
    to_a = a @ back[..., :2].transpose(0, 2, 1) + back[:, None, :, 2]
    d = np.minimum(_distance_across(to_b, 2), _distance_across(to_a, 1))
    gain = np.maximum(1 - (d / TOLERANCE_PX) ** 2, WORST).astype(np.float32)
    gain = np.stack([gain, gain[..., ::-1]], axis=1)                    # and B read backwards: (P, 2, S, S)
    step_a, step_b = ((x / (SAMPLES - 1))[:, None, None].astype(np.float32) for x in (length_a, length_b))
    total = _fill(gain, step_a, step_b)
    matched = total.reshape(len(a), 2, -1).max(axis=2)
    share = matched / (length_a + length_b)[:, None]
    # a device is seen whole by both
    score = np.sqrt(matched) * share**2 * weights[:, None]

    def made(p: int, flip: int) -> Alignment | None:
        if matched[p, flip] < SHORTEST_PX:
            return None
        i, j = _trace(total[p, flip], gain[p, flip], float(length_a[p]), float(length_b[p]))
        if min(np.ptp(i), np.ptp(j)) < 5:       # a point of one plane against a line of the other is no curve
            return None
        return Alignment(int(pairs[p, 0]), int(pairs[p, 1]), bool(flip), float(score[p, flip]),
                         i * length_a[p] / (SAMPLES - 1), j * length_b[p] / (SAMPLES - 1))

    for p, flip in np.ndindex(len(a), 2):
        yield float(score[p, flip]), partial(made, p, flip)


def _sampled(curves: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(n, SAMPLES, 2) evenly spaced points of each curve and (n,) lengths in px."""
    lengths = np.array([arc_length(c)[-1] for c in curves])
    return np.stack([at_arc_length(c, np.linspace(0, n, SAMPLES)) for c, n in zip(curves, lengths)]), lengths


def _distance_across(signed: np.ndarray, axis: int) -> np.ndarray:
    """|signed|, and 0 where the curve crosses the line before or after this sample along `axis`."""
    d = np.abs(signed)
    s = np.moveaxis(signed, axis, -1)
    out = np.moveaxis(d, axis, -1)      # a view: writes go to d
    crosses = s[..., :-1] * s[..., 1:] <= 0
    out[..., :-1][crosses] = 0
    out[..., 1:][crosses] = 0
    return d


def _fill(gain: np.ndarray, step_a: np.ndarray, step_b: np.ndarray) -> np.ndarray:
    """(..., S, S) best score of an alignment that ends at each pair of samples; rows one after another, all pairs of
    curves at once."""
    total = np.zeros_like(gain)
    before = np.zeros(gain.shape[:-2] + (gain.shape[-1],), gain.dtype)
    for i in range(gain.shape[-2]):
        g = gain[..., i, :]
        diagonal = np.concatenate([np.zeros_like(before[..., :1]), before[..., :-1]], axis=-1) + g * (step_a + step_b)
        start = np.maximum(np.maximum(before + g * step_a, diagonal), 0)
        run = np.cumsum(g * step_b, axis=-1)                        # moving along B only: a running sum ...
        before = run + np.maximum.accumulate(start - run, axis=-1)  # ... from the best place to enter it
        total[..., i, :] = before
    return total


def _trace(total: np.ndarray, gain: np.ndarray, length_a: float, length_b: float) -> tuple[np.ndarray, np.ndarray]:
    """(K,) and (K,) samples along the best alignment, from its first to its last."""
    sa, sb = length_a / (SAMPLES - 1), length_b / (SAMPLES - 1)
    i, j = np.unravel_index(np.argmax(total), total.shape)
    path = [(i, j)]
    while i > 0 and j > 0 and total[i, j] > 0:
        g = gain[i, j]
        options = (total[i - 1, j - 1] + g * (sa + sb), total[i - 1, j] + g * sa, total[i, j - 1] + g * sb)
        k = int(np.argmax(options))
        if options[k] <= 1e-9:
            break
        i, j = i - (k != 2), j - (k != 1)
        path.append((i, j))
    along = np.array(path[::-1], float)
    return along[:, 0], along[:, 1]
