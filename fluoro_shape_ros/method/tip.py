"""Which end of the device is its tip: the one place where the contract's rule stands."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..config import Config
from ..data import View
from ..geometry.cameras import distort, project
from ..imaging.field import border_distance
from .known_device import ALIKE, SURE, Likeness


def tip_is_last(ends: np.ndarray, at_border: tuple[bool, bool], border_px: Callable[[], np.ndarray],
                base_position: Sequence[float] = (),
                previous: np.ndarray | None = None, alike: Callable[[], Likeness] = lambda: ALIKE) -> tuple[bool, bool]:
    """Whether the last of a device's two ends is the tip, and whether that is a guess.

    ends: (2, 3) first and last point, m. at_border: whether each lies at the field's border in a plane.
    border_px: called only when all else fails, gives the (2, 2) distance of each end (row) from the nearest border in
    each plane (column). base_position: where the device enters, m, or empty. previous: (N, 3) the last result, base to
    tip, m. alike: called only when these tell nothing, what the device's description says.
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
    if abs(nats := alike().last_is_tip) > SURE:
        return nats > 0, False
    # farther from the border in both planes; where the planes contradict each other the nearer border of both decides
    nearest = border_px().min(axis=1)
    return bool(nearest[1] >= nearest[0]), True


def tip_of(ends: np.ndarray, at_border: tuple[bool, bool], views: Sequence[View], fields: Sequence[np.ndarray],
           config: Config, known: np.ndarray | None,
           alike: Callable[[], Likeness] = lambda: ALIKE) -> tuple[bool, bool]:
    """The contract's rule on a backbone's two ends (2, 3): whether the last is the tip, and whether that is a guess."""
    def border_px() -> np.ndarray:
        return np.stack([border_distance(f, distort(v, project(v.P, ends))) for f, v in zip(fields, views)], axis=1)
    return tip_is_last(ends, at_border, border_px, config.curve.base_position, known, alike)
