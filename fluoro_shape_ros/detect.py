"""method:=spline from images to a fitted curve: ridges > candidates > the pair that is one device > a spline on both images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from .centerline import find_ridges, ridge_scale, shrinking
from .chains import Candidate, find_candidates
from .data import Outcome
from .fit import Fit, contrast_ratio, fit, shown
from .geometry import distort, fundamental, isocenter, pixels_per_metre, project, undistort
from .matching import align
from .start import first_curve
from .strips import apparent_width, cut_along, half_width_range, likeness, odd_width, pieces

LINES = 14              # strongest lines of an image that are looked at closely
CANDIDATES = 6          # most device-like ones among them that are compared between the planes ...
HOPELESS = 0.03         # ... unless they are that much less like it than the best
HYPOTHESES = 4          # alignments that are fitted before one is chosen
CONTRAST_RATIO = 0.3    # natural logarithm: planes differ in energy and scatter
UNLIKE = 0.05           # a correlation less by this than 1 makes a profile e times less likely the device's
ODD_WIDTH = 0.2         # an odd width by this makes a line exp(1/2) times less likely the device
EXPLAINED_PX = 3.0
MIN_EXPLAINED = 0.4     # less of a line than this, and it is another line
CONVINCING = 0.6        # evidence for a length of 1 m that needs no other hypothesis beside it
ASIDE = 0.8             # darkness beside where a tracked fit would go on, as a share of the device's, that makes one search anew
NO_TIP = 0.2            # what is left of a line that leaves the field at both ends: it has no tip to show


@dataclass(frozen=True)
class Detection:
    """What the images show: a fit, or the reason why there is none; and the device's candidates as seen, for the overlay."""

    fit: Fit | None
    outcome: Outcome
    detail: str
    seen_px: tuple[np.ndarray | None, np.ndarray | None]    # (N, 2) image pixels as received


def detect(images, fields, views, radius: float, min_length_px: float) -> Detection:
    """Search both whole images (H, W float32, dark device) for the device of `radius` m."""
    center = isocenter(views)[None]
    widths = [radius * pixels_per_metre(v.P, center) for v in views]
    candidates = [candidates_of(*plane, min_length_px) for plane in zip(images, fields, widths)]
    best = tuple(c[0].points_px if c else None for c in candidates)
    for found, outcome in zip(candidates, (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)):
        if not found:
            return Detection(None, outcome, f'no line of at least {min_length_px:g} px stands out', best)
    curves = [[undistort(v, c.points_px) for c in found] for v, found in zip(views, candidates)]
    F = fundamental(views[0].P, views[1].P)
    fits = []
    for alignment in align(*curves, [np.array([c.score for c in found]) for found in candidates], F, best=HYPOTHESES):
        start = first_curve(views, curves[0][alignment.a], curves[1][alignment.b], alignment)
        fitted = fit(images, fields, views, start, radius)
        if fitted is not None:
            lines = curves[0][alignment.a], curves[1][alignment.b]
            taken = candidates[0][alignment.a], candidates[1][alignment.b]
            share = min(explained(fitted, v, line, c.z > 0) for v, line, c in zip(views, lines, taken))
            fits.append((share * evidence(fitted), fitted, share, tuple(c.points_px for c in taken)))
            if fits[-1][0] > CONVINCING * np.sqrt(fitted.stop - fitted.start):
                break
    if not fits:
        return Detection(None, Outcome.NO_CORRESPONDENCE, f'no line of plane a ({len(candidates[0])}) is one of plane b ({len(candidates[1])})', best)
    _, fitted, share, seen = max(fits, key=lambda f: f[0])
    if share < MIN_EXPLAINED:
        return Detection(None, Outcome.POORLY_EXPLAINED, f'only {100 * share:.0f} % of the line seen in one plane are explained', seen)
    return Detection(fitted, Outcome.OK, 'ok', seen)


def track(images, fields, views, radius: float, points: np.ndarray) -> Detection | None:
    """Fit from where the device was, (N, 3) m; None where it is no longer there, so that the whole images must be searched."""
    fitted = fit(images, fields, views, points, radius, coarse=1)
    if fitted is None or evidence(fitted) < CONVINCING * np.sqrt(fitted.stop - fitted.start) or fitted.aside.max() > ASIDE:
        return None
    ends = np.linspace(fitted.start, fitted.stop, 100)
    return Detection(fitted, Outcome.OK, 'ok', tuple(distort(v, project(v.P, fitted.spline(ends))) for v in views))


def candidates_of(image, field, half_width_px: float, min_length_px: float) -> list[Candidate]:
    """The lines of one image that look most like a device of this width, best first; `score` is how much, at most 1."""
    lines = find_candidates(find_ridges(image, field, ridge_scale(half_width_px), shrinking(half_width_px)), min_length_px, count=LINES)
    if not lines:
        return []
    strips, of = cut_along(image, field, [line.points_px for line in lines], half_width_range(half_width_px))
    profiles, of = pieces(strips.profiles, strips.inside, of)
    alike = likeness(profiles, half_width_px)
    seen = [apparent_width([alike[of == k]]) for k in range(len(lines))]
    scored = [replace(line, score=alike_device(odd_width(width, half_width_px), alike)) for line, (width, alike) in zip(lines, seen)]
    scored.sort(key=lambda c: -c.score * np.sqrt(len(c.z)))
    return [c for c in scored[:CANDIDATES] if c.score > HOPELESS * scored[0].score]


def explained(f: Fit, view, line_px: np.ndarray, visible: np.ndarray) -> float:
    """Share of an (N, 2) undistorted centreline that lies within EXPLAINED_PX of the fitted curve's projection.

    Pieces beyond a gap in the line (`visible` (N,) false) that the curve has nothing to do with do not count: they may be another line. Nor does
    what lies past an end where the device leaves the other plane's field.
    """
    projected = project(view.P, f.spline(np.arange(f.start, f.stop, f.s[1] - f.s[0])))
    distance, nearest = cKDTree(projected).query(line_px)
    near = distance < EXPLAINED_PX
    elsewhere = ~near & (((nearest == 0) & f.open_end[0]) | ((nearest == len(projected) - 1) & f.open_end[1]))
    piece = np.cumsum(np.diff(visible.astype(int), prepend=1) == 1)
    share = np.bincount(piece, near) / np.bincount(piece)
    counted = (share[piece] > 0.2) & ~elsewhere
    return float(near[counted].mean()) if counted.any() else 0.0


def evidence(f: Fit) -> float:
    """How much speaks for a fit: a device looks like a cylinder of about its radius, is seen all along and equally dark by both planes, and stops in both at once."""
    if f.contrast.min() <= 0:
        return 0.0
    alike = np.exp(-0.5 * (np.log(contrast_ratio(f)) / CONTRAST_RATIO) ** 2)
    goes_on = np.clip(f.beyond[~f.open_end].max(axis=1), 0, 1)
    closed = float(np.exp(-2 * (goes_on**2).sum())) if len(goes_on) else NO_TIP
    return float(np.sqrt(f.stop - f.start) * shown(f).min() * alike * closed * alike_device(f.odd_width, f.likeness))


def alike_device(odd: float, likeness: np.ndarray) -> float:
    """At most 1: how device-like lines are, by their odd width and their (V,) likeness with cylinders of their own width."""
    return float(np.exp((np.clip(likeness, 0, 1).mean() - 1) / UNLIKE - 0.5 * (odd / ODD_WIDTH) ** 2))
