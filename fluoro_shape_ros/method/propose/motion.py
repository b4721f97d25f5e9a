"""Where the device should be by now: as it moved between the last two pairs, so it goes on."""

from __future__ import annotations

import numpy as np

from ...data import Prior

APART_NS = 500_000_000  # pairs farther apart do not tell a velocity
AHEAD = 2.0             # times as far ahead as they lie apart: one pair may have been missed
FAR = 0.008             # m: who says it has moved farther is not believed


def going_on(prior: Prior, stamp_ns: int) -> np.ndarray | None:
    """(N, 3) m, base to tip, at constant velocity; None where the last two results do not tell any."""
    if (prior.previous is None or prior.before is None or prior.previous_stamp_ns is None
            or prior.before_stamp_ns is None):
        return None
    apart, ahead = prior.previous_stamp_ns - prior.before_stamp_ns, stamp_ns - prior.previous_stamp_ns
    if not (0 < apart <= APART_NS and 0 < ahead <= AHEAD * apart):
        return None
    now, then = prior.previous, prior.before
    share = now.s / now.length      # places are the same ones at the same share of the length
    moved = now.points - np.stack([np.interp(share, then.s / then.length, x) for x in then.points.T], axis=1)
    moved *= ahead / apart
    return now.points + moved if np.linalg.norm(moved, axis=1).max() < FAR else None
