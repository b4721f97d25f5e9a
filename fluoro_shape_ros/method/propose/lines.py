"""Hypotheses from lines: what one image shows as a line of the device's width, and which line of plane A may be which
of plane B."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...data import View
from ...geometry.cameras import fundamental, isocenter, pixels_per_metre, undistort
from ...imaging.lines import GAP_PX, Candidate, find_candidates
from ...imaging.oriented import along_lines
from ...imaging.parallel import both
from ...imaging.profiles import apparent_width, likeness, odd_width, pieces
from ...imaging.ridges import Ridges, find_ridges, ridge_scale, shrinking
from ...imaging.strips import Sheet, cut_along, half_width_range
from .alignment import align
from .first_curve import first_curve

LINES = 40              # strongest lines of an image that are looked at closely ...
CANDIDATES = 20         # ... and most device-like ones among them that are compared between the planes
ALIGNMENTS = 130        # of a line of each plane that are proposed
NEARLY = 0.7            # score of a pair of lines, or of the same read the other way round, as a share of the best
                        # one's, that must be tried, too
UNLIKE, ODD = 0.3, 0.6  # difference to a cylinder's profile (correlation), and to its width (logarithm), that make a
                        # line less likely the device's
FAINT_LENGTH_PX = 7.0   # sigma along which faint lines are averaged, in px of the smaller image
FAINT_GAP_PX = 96.0     # longest gap that is bridged in them: some of them are seen in pieces only
FAINT_SCALE = 0.7       # of the half width there, that is the filter's scale; at least FINEST px
FINEST = 0.9

Lines = tuple[Candidate | None, Candidate | None]   # of planes a and b; None where the line there is not the device's


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Where the device may be."""

    curve: np.ndarray           # (M, 3) m
    lines: Lines = (None, None) # that say so
    coarse: int = 0             # how often the fit searches around it
    clearing: bool = False      # whether lines beside it are taken away
    score: float = 0.0          # of the lines that say so, see alignment.Alignment


def candidates(sheet: Sheet, radius: float, min_length_px: float,
               faint: bool) -> tuple[list[Candidate], list[Candidate]]:
    """The most device-like lines of each plane, best first; `faint` ones are averaged along themselves, which takes
    longer."""
    center = isocenter(sheet.views)[None]
    widths = [radius * pixels_per_metre(v.P, center) for v in sheet.views]
    return both(lambda image, field, width: _candidates(image, field, width, min_length_px, faint), sheet.planes,
                sheet.fields, widths, pixels=sum(p.size for p in sheet.planes))


def by_lines(views: Sequence[View], found: tuple[list[Candidate], list[Candidate]]) -> Iterator[Hypothesis]:
    """One for a line of each plane that may be the same device, most likely first; the other direction only where that
    fits about as well."""
    if not all(found):
        return
    curves = [[undistort(v, c.points_px) for c in lines] for v, lines in zip(views, found)]
    scores: dict[tuple[int, int], float] = {}
    for alignment in align(curves[0], curves[1], [np.array([c.score for c in lines]) for lines in found],
                           fundamental(views[0].P, views[1].P), best=ALIGNMENTS):
        a, b = alignment.a, alignment.b
        if alignment.score >= NEARLY * scores.setdefault((a, b), alignment.score):
            yield Hypothesis(first_curve(views, curves[0][a], curves[1][b], alignment), (found[0][a], found[1][b]),
                             score=alignment.score)


def _candidates(image: np.ndarray, field: np.ndarray, half_width_px: float, min_length_px: float,
                faint: bool) -> list[Candidate]:
    ridges = (_faint_ridges(image, field, half_width_px) if faint
              else find_ridges(image, field, ridge_scale(half_width_px), shrinking(half_width_px)))
    lines = find_candidates(ridges, min_length_px, LINES, FAINT_GAP_PX if faint else GAP_PX)
    if not lines:
        return []
    strips, of = cut_along(image, field, [line.points_px for line in lines], half_width_range(half_width_px))
    profiles, of = pieces(strips.profiles, strips.inside, of)
    alike = likeness(profiles, half_width_px)
    seen = [apparent_width([alike[of == k]]) for k in range(len(lines))]
    scored = [replace(line, score=_device_like(width, half_width_px, float(a.mean())))
              for line, (width, a) in zip(lines, seen)]
    scored.sort(key=lambda c: -c.score * np.sqrt(len(c.z)))
    return scored[:CANDIDATES]


def _device_like(width: float, half_width_px: float, alike: float) -> float:
    """At most 1: how much a line of this `width` (see apparent_width) and likeness to a cylinder looks like a device;
    hollow and coiled ones are less alike."""
    return float(np.exp((max(alike, 0.0) - 1) / UNLIKE - 0.5 * (odd_width(width, half_width_px) / ODD)**2))


def _faint_ridges(image: np.ndarray, field: np.ndarray, half_width_px: float) -> Ridges:
    """Ridges of the image averaged along lines, looked for in an image half as large, or a quarter for wide devices."""
    k = 2 if half_width_px < 4 else 4
    size = image.shape[1] // k, image.shape[0] // k
    image, field = (a[:size[1] * k, :size[0] * k] for a in (image, field))
    sigma = max(FAINT_SCALE * half_width_px / k, FINEST)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    dark = along_lines(image, sigma, FAINT_LENGTH_PX)
    ridges = find_ridges(image.max() - dark, cv2.resize(field, size, interpolation=cv2.INTER_NEAREST), sigma)
    return Ridges(ridges.points_px * k + (k - 1) / 2, ridges.z, ridges.start, k)
