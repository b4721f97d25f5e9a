"""Where the device was, or where a prediction has it: looked for in a region around that, without a search of the whole
images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data import Frame, Prior, View
from ..imaging.prepare import region_around, sheet_of
from ..imaging.strips import Sheet
from .fit.fit import fit
from .fit.result import Fit
from .prediction import Guess, borne_out, whole
from .propose.follow import follow, reach_px
from .propose.motion import going_on
from .search import at_rest, projected

EDGE_PX = 30            # an end this near to the region's edge may go on beyond it
JUMPED = 4e-3           # m: an end farther from where it was, or should be by now, may have slipped on to another line
LOOKED_PX = 48.0        # past both ends of the path that a guess leads to, which often stops short of the device's


@dataclass(frozen=True, eq=False)
class Near:
    """A fit near where the device was or should be."""

    fit: Fit
    sheet: Sheet        # of the regions it was found in
    alone: bool         # whether nothing but its probability asks for a search of the whole images


def tracked(frame: Frame, images: Sequence[np.ndarray], fields: Sequence[np.ndarray], polarity: str, radius: float,
            prior: Prior) -> Near | None:
    """The device where it would be at constant velocity, else near where it was; None where it is at neither place."""
    expected = going_on(prior, frame.stamp_ns)
    previous = None if prior.previous is None else prior.previous.points
    for points, coarse in ((expected, None), (previous, 1)):
        if points is None:
            continue
        regions = [region_around(v, points) for v in frame.views]
        sheet = sheet_of(images, fields, frame.views, polarity, regions)
        fitted = fit(sheet, points, radius, coarse)
        if fitted is not None and not _cut_off(fitted, sheet, regions, frame.views):
            ends, before = fitted.curve(2), points[[0, -1]]
            jumped = min(np.linalg.norm(e - before, axis=1).max() for e in (ends, ends[::-1])) > JUMPED
            return Near(fitted, sheet, not jumped)
    return None


def predicted(frame: Frame, images: Sequence[np.ndarray], fields: Sequence[np.ndarray], polarity: str, radius: float,
              guess: Guess) -> Near | None:
    """The device near a guess; None where the images show none there that bears it out."""
    regions = [region_around(v, guess.points, reach_px(guess, v)) for v in frame.views]
    sheet = sheet_of(images, fields, frame.views, polarity, regions)
    start = follow(sheet, guess, radius)
    if start is None or not borne_out(start, guess):
        return None
    fitted = at_rest(sheet, fit(sheet, start, radius, 1, LOOKED_PX), radius, beyond_px=LOOKED_PX)
    if fitted is None or _cut_off(fitted, sheet, regions, frame.views) or not borne_out(fitted.curve(100), guess):
        return None
    return Near(fitted, sheet, whole(fitted.stop - fitted.start, guess, sheet.views))


def _cut_off(fitted: Fit, sheet: Sheet, regions: Sequence[tuple[slice, slice]], views: Sequence[View]) -> bool:
    """Whether it ends at the edge of a region that is not the image's: there it may go on."""
    for (rows, columns), view, part in zip(regions, views, sheet.views):
        ends, last = projected(fitted, part)[[0, -1]], np.array([columns.stop - columns.start, rows.stop - rows.start])
        low, high = (np.array([columns.start, rows.start]) > 0,
                     np.array([columns.stop, rows.stop]) < [view.width, view.height])
        if ((ends < EDGE_PX) & low | (ends > last - EDGE_PX) & high).any():
            return True
    return False
