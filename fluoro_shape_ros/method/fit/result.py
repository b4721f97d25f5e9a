"""What the stages of a fit hand on: a curve that has come to rest, and the fit it makes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry.curve import middle
from ...geometry.spline import Spline3
from ...imaging.strips import Measurement, Model, Strips
from .ends import SMOOTH_PX
from .solver import Layout, Solution


@dataclass(frozen=True)
class Fit:
    """A curve that lies on the device in both images."""

    spline: Spline3
    start: float                # m, arc length where the device begins ...
    stop: float                 # ... and where it ends
    end_sigma: np.ndarray       # (2,) m, of those two along the curve
    open_end: np.ndarray        # (2,) bool: the device leaves the field there
    covariance: np.ndarray      # (3 n, 3 n) m^2 of the control points
    s: np.ndarray               # (N,) m
    presence: np.ndarray        # (N, 2)
    offset_px: np.ndarray       # (N, 2) of the device from the fitted curve; NaN where not measured
    power: float                # 1: translucent, 0: opaque, see opacity.exponent
    beyond: np.ndarray          # (2, 2) darkness just past the first and the last end (rows) in plane A, B, as a share
                                # of the device's
    aside: np.ndarray           # (2, 2) the same of a line beside where each end would go on
    farther: np.ndarray         # (2,) nats by which both planes show it going on past each end, straight on or bent
    alone: np.ndarray           # (2,) the plane that alone tells where each end is, because a line hides it in the
                                # other; -1: both tell
    moved_px: float             # how far the last step of the solver moved it, at most: a fit that still moves has not
                                # come to rest
    seen_at: np.ndarray | None = None       # (2, 2) m, where the first and the last end (rows) are by plane A, B alone;
                                            # NaN where one does not tell well
    seen_sigma: np.ndarray | None = None    # (2, 2) m
    bent: np.ndarray | None = None          # (N, 3) m, the curve going on in a bend past an end, where both planes show
                                            # something there

    def curve(self, count: int) -> np.ndarray:
        """(count, 3) m along the device."""
        return self.spline(np.linspace(self.start, self.stop, count))


@dataclass(frozen=True)
class Rest:
    """A curve that has come to rest, and what the strips across it say."""

    layout: Layout
    solution: Solution
    strips: Strips
    measured: Measurement
    within: np.ndarray              # (N,) bool: the strips that counted
    model: Model
    clutter: np.ndarray             # (2, N) see strips.clutter, over ...
    along_px: np.ndarray            # ... (2,)
    stretch: tuple[int, int]        # first and last strip of the device

    @property
    def reference(self) -> tuple[float, float]:
        """m, where the device begins and where it ends."""
        return self.layout.s[self.stretch[0]], self.layout.s[self.stretch[1]]

    @property
    def at_ends(self) -> tuple[np.ndarray, np.ndarray]:
        """(2, 2) `usual` darkness, and `clutter` over SMOOTH_PX, at the first and the last end (rows) in each plane."""
        ends = list(self.stretch)
        return self.measured.usual[:, ends].T, self.clutter[:, ends].T * np.sqrt(self.along_px / SMOOTH_PX)

    @property
    def typical(self) -> np.ndarray:
        """(2,) darkness of most of the device in each plane."""
        first, last = self.stretch
        dark = self.measured.presence[:, first:last + 1] * self.measured.usual[:, first:last + 1]
        return np.maximum(middle(np.nan_to_num(dark), axis=1), 1e-9)

    @property
    def beyond(self) -> np.ndarray:
        """(2, 2) darkness past the first and the last end (rows) in each plane, see _beyond."""
        presence = self.measured.presence.T
        return np.stack([_beyond(presence, self.stretch[0], -1), _beyond(presence, self.stretch[1], 1)])

    @property
    def known_beyond(self) -> np.ndarray:
        """(2,) bool: whether both planes' fields reach past the first and the last end."""
        return ~np.isnan(self.beyond).any(axis=1)


def _beyond(presence: np.ndarray, at: int, outward: int) -> np.ndarray:
    """(2,) darkness that each plane shows just past strip `at`, as a share of the device's; NaN outside its field, 1
    where the strips end before it does."""
    past = presence[at + 5:at + 22] if outward > 0 else presence[max(at - 21, 0):max(at - 4, 0)]
    if len(past) < 10:
        return np.where(np.isnan(past).any(axis=0), np.nan, 1.0)
    return np.where(np.isnan(past).any(axis=0), np.nan, middle(past, axis=0))
