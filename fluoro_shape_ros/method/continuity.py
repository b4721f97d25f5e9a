"""Where the device was, as a term of the judge: how likely it is that it should be where a curve has it by now."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..data import Prior
from .features import TIP

FASTEST = 0.15          # m/s, that a device moves at
LEAPS = 1.0             # 1/s: how often it is elsewhere without having been seen on its way, since the stream, the
                        # table or the patient went on


def continuity(points: np.ndarray, prior: Prior, stamp_ns: int) -> float:
    """Nats that where the device was says for an (N, 3) curve in the pair of `stamp_ns`: at most 0, and 0
    where that is not known.

    Within t it moves by FASTEST t + TIP, as a Gaussian has it beyond that, unless it has leapt, with the probability
    1 - exp(-LEAPS t). So what is found elsewhere an eye-blink later needs more evidence, and some time later none.
    """
    if prior.previous is None or prior.previous_stamp_ns is None or stamp_ns <= prior.previous_stamp_ns:
        return 0.0
    seconds, before = 1e-9 * (stamp_ns - prior.previous_stamp_ns), prior.previous.points
    # which end is the tip is another question
    tip = float(np.linalg.norm(points[[0, -1]] - before[-1], axis=1).min())
    far = max(float(cKDTree(before).query(points)[0].mean()), tip)
    reach = FASTEST * seconds + TIP
    leap = -np.expm1(-LEAPS * seconds)
    return float(np.log(leap + (1 - leap) * np.exp(-0.5 * max(far / reach - 1, 0.0)**2)))
