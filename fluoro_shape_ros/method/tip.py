"""Which end of the device is its tip: the one place where the contract's rule stands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def tip_is_last(ends: np.ndarray, at_border: tuple[bool, bool], border_px: Callable[[], np.ndarray], base_position=(),
                previous: np.ndarray | None = None) -> tuple[bool, bool]:
    """Whether the last of a device's two ends is the tip, and whether that is a guess.

    ends: (2, 3) first and last point, m. at_border: whether each lies at the field's border in a plane. border_px: called only when all else
    fails, gives the (2, 2) distance of each end (row) from the nearest border in each plane (column). base_position: where the device enters, m, or
    empty. previous: (N, 3) the last result, base to tip, m.
    """
    first, last = at_border
    if first != last:
        return first, False
    if len(base_position):
        d = np.linalg.norm(ends - np.asarray(base_position), axis=1)
        return bool(d[1] > d[0]), False
    if previous is not None:
        same = np.linalg.norm(ends[0] - previous[0]) + np.linalg.norm(ends[1] - previous[-1])
        swapped = np.linalg.norm(ends[1] - previous[0]) + np.linalg.norm(ends[0] - previous[-1])
        return bool(same <= swapped), False
    # farther from the border in both planes; where the planes contradict each other the nearer border of both decides
    nearest = border_px().min(axis=1)
    return bool(nearest[1] >= nearest[0]), True
