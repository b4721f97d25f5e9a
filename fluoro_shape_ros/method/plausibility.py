"""Whether a reconstruction may be believed; every doubt has a name."""

from __future__ import annotations

import numpy as np

from ..config import Config
from ..geometry.curve import curvature, middle
from ..data import Outcome
from .fit.fit import Fit, contrast_ratio, crowded, ends_shown, shown

MIN_LIKENESS = 0.96     # correlation of the profile seen with a cylinder's shadow, in the worse plane
MIN_WEAKEST = 0.9      # the same, of the best of the worst pieces in a row
MAX_ODD_WIDTH = 0.15    # see profiles.odd_width: robot_radius may be off by a third
MAX_CONTRAST_RATIO = 2.0
MIN_SHOWN = 0.6         # share of the device's length that each plane must show
MAX_BEYOND = 0.6        # darkness past an end, in the plane that shows more: the planes disagree where the device ends
MIN_BEYOND = -0.25      # darkness past an end, in both planes: what is brighter there lies beside something dark, and the device turns aside
MAX_ASIDE = 0.7         # darkness, in both planes, of a line beside where an end would go on
TURNED_ASIDE, TURNED_BEYOND = 0.9, -0.3     # both at once, in either plane
MIN_END_SHOWN = 0.5     # presence of the device's last stretch in either plane ...
MIN_END_DARK = 0.71     # ... and in both on average, or in the one that alone shows the end: the edge of a bone beyond it is half as dark ...
MIN_CROWDED_DARK = 0.8  # ... where both planes show something beside it
MAX_FADING = -0.34      # natural logarithm of how dark both planes show its last pieces, beside the others, unless its ends are clear
PALE, BESIDE = 0.7, 0.3 # presence of the last stretch in one plane, and darkness of a line beside it there that may be the device ...
CERTAIN_PALE = 0.7      # ... unless the evidence is as good as this
MAX_END_SIGMA, MAX_END_PX = 1.2e-3, 4.0     # m, or px where those are larger: standard deviation of an end along the device
BLUNT, BLUNT_PX = 0.35e-3, 1.2          # the same, from which on an end is not clear: then a line beside it by MAX_ASIDE in one plane may be the device's ...
BARE = 0.05             # ... unless straight on it is at least so dark there
CLEAR, CLEAR_PX = 0.12e-3, 0.4          # the same, up to which an end is clear: lines that meet by chance do not end so, both at once and in both planes ...
CLEAR_BEYOND = 0.4      # ... and darkness past it ...
CLEARER = 2.0           # ... so that this many times as much speaks for a fit with two such ends, and its profile may be less round:
CLEAR_LIKENESS, CLEAR_WEAKEST = 0.93, 0.85
EXPECTED = 1.4          # times as much speaks for a fit where a prediction has the device
MIN_CONTRAST = 0.02
MIN_EVIDENCE = 0.4      # see `evidence`, for a length of 1 m
CERTAIN, CERTAIN_WEAKEST = 0.6, 0.95    # the same, and the least likeness in a row, of a fit with an end that only one plane shows
CONTRAST_RATIO = 0.3    # natural logarithm: planes differ in energy and scatter
UNLIKE = 0.05           # a correlation less by this than 1 makes a profile e times less likely the device's
ODD_WIDTH = 0.2         # an odd width by this makes a line exp(1/2) times less likely the device
NO_TIP = 0.2            # what is left of a line that leaves the field at both ends: it has no tip to show


def evidence(f: Fit, expected: bool = False) -> float:
    """How much speaks for a fit: a device looks like a cylinder of about its radius, is seen all along and equally dark by both planes, and stops in both at once.

    expected: a prediction has it there.
    """
    if f.contrast.min() <= 0:
        return 0.0
    alike = np.exp(-0.5 * (np.log(contrast_ratio(f)) / CONTRAST_RATIO) ** 2)
    goes_on = np.clip(f.beyond[~f.open_end].max(axis=1), 0, 1)
    closed = float(np.exp(-2 * (goes_on**2).sum())) if len(goes_on) else NO_TIP
    favour = (CLEARER ** (0.5 * np.count_nonzero(~f.open_end)) if clear(f, expected) else 1.0) * (EXPECTED if expected else 1.0)
    return float(np.sqrt(f.stop - f.start) * shown(f).min() * alike * closed * alike_device(f.odd_width, f.likeness) * favour)


def alike_device(odd: float, likeness: np.ndarray) -> float:
    """At most 1: how device-like lines are, by their odd width and their (V,) likeness with cylinders of their own width."""
    return float(np.exp((np.clip(likeness, 0, 1).mean() - 1) / UNLIKE - 0.5 * (odd / ODD_WIDTH) ** 2))


def blunt(f: Fit) -> np.ndarray:
    """(2,) bool: whether the images show the first and the last end, but not clearly where it is."""
    return ~f.open_end & (f.end_sigma > max(BLUNT, BLUNT_PX * (f.s[1] - f.s[0])))


def clear(f: Fit, expected: bool = False) -> bool:
    """Whether both planes show, and agree on, where the device begins and where it ends.

    expected: a prediction has it there, then it may leave the field at one end if neither plane shows the other one pale.
    """
    seen = ~f.open_end
    if not (seen.all() or expected and seen.any() and ends_shown(f)[seen].min() > PALE):
        return False
    return bool(f.end_sigma[seen].max() < max(CLEAR, CLEAR_PX * (f.s[1] - f.s[0])) and f.beyond[seen].max() < CLEAR_BEYOND)


def doubt(f: Fit, min_length_px: float, expected: bool = False) -> tuple[Outcome, str] | None:
    """Whether what both planes show along a fitted curve is one device of at least `min_length_px`: None, or the rejection. expected: a prediction has it there."""
    px = f.s[1] - f.s[0]    # m
    length_px = (f.stop - f.start) / px
    if length_px < min_length_px:
        return Outcome.NO_CORRESPONDENCE, f'only {length_px:.0f} px are seen by both planes'
    certain = clear(f, expected)
    if f.contrast.min() < MIN_CONTRAST or f.likeness.min() < (CLEAR_LIKENESS if certain else MIN_LIKENESS):
        return Outcome.POORLY_EXPLAINED, 'its profile is not that of a round device (likeness {:.2f}, {:.2f})'.format(*f.likeness)
    if f.weakest.min() < (CLEAR_WEAKEST if certain else MIN_WEAKEST):
        return Outcome.POORLY_EXPLAINED, 'part of it does not look like a round device (likeness {:.2f}, {:.2f}): it follows another line there'.format(*f.weakest)
    if f.odd_width > MAX_ODD_WIDTH:
        return Outcome.POORLY_EXPLAINED, f'it looks {f.width:.1f} times as wide as a device of robot_radius'
    ratio = contrast_ratio(f)
    if ratio > MAX_CONTRAST_RATIO:
        return Outcome.DIRECTIONS_DISAGREE, f'one plane shows it {ratio:.1f} times as dark as the other'
    share = shown(f)
    if share.min() < MIN_SHOWN:
        return Outcome.POORLY_EXPLAINED, f'only {100 * share.min():.0f} % of it are seen in plane {"ab"[int(share.argmin())]}'
    speaks, each, by = evidence(f) / np.sqrt(f.stop - f.start), ends_shown(f), f.alone        # of where it ends a prediction tells nothing
    alone = by >= 0
    if alone.any() and (speaks < CERTAIN or f.weakest.min() < CERTAIN_WEAKEST):
        return Outcome.POORLY_EXPLAINED, 'a line hides one of its ends in one plane, and too little else speaks for it'
    end_dark = np.where(alone, each[[0, 1], by], each.mean(axis=1))
    for k, name in enumerate(('first', 'last')):
        if not f.open_end[k] and (f.beyond[k].max() > MAX_BEYOND or f.end_sigma[k] > max(MAX_END_SIGMA, MAX_END_PX * px)):
            return Outcome.DIRECTIONS_DISAGREE, f'the planes disagree where its {name} end lies'
        turned = (f.aside[k] > TURNED_ASIDE) & (f.beyond[k] < TURNED_BEYOND)
        if not (certain or alone[k] or f.open_end[k]) and (f.beyond[k].max() < MIN_BEYOND or f.aside[k].min() > MAX_ASIDE or turned.any()):
            return Outcome.POORLY_EXPLAINED, f'it turns aside at its {name} end and could not be followed'
        if blunt(f)[k] and ((f.aside[k] > MAX_ASIDE) & (f.beyond[k] < BARE)).any():
            return Outcome.POORLY_EXPLAINED, f'its {name} end is not clear, and a line beside it goes on'
        if each[k].min() < MIN_END_SHOWN:
            return Outcome.DIRECTIONS_DISAGREE, f'only one plane shows its {name} end'
        if end_dark[k] < (MIN_CROWDED_DARK if crowded(f)[k] else MIN_END_DARK) or (f.fading[k] < MAX_FADING and not clear(f)):
            return Outcome.POORLY_EXPLAINED, f'it fades towards its {name} end: it follows the edge of something there'
        if speaks < CERTAIN_PALE and ((each[k] < PALE) & (f.aside[k] > BESIDE)).any():
            return Outcome.POORLY_EXPLAINED, f'in one plane it fades towards its {name} end, and there is a line beside it'
    if all(f.open_end):
        return Outcome.DIRECTIONS_DISAGREE, 'it leaves the field at both ends: no tip is seen'
    if evidence(f, expected) < MIN_EVIDENCE * np.sqrt(f.stop - f.start):
        return Outcome.POORLY_EXPLAINED, 'too little speaks for it being one device in both planes (likeness, darkness, ends)'
    return None


def check_tip(covariance: np.ndarray, config: Config) -> tuple[Outcome, str] | None:
    """Standard deviation of the tip in its worst direction, from its (3, 3) covariance in m^2: None, or the rejection."""
    limit = config.plausibility.max_tip_sigma
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) if np.isfinite(covariance).all() else float('inf')
    if limit and not sigma <= limit:
        return Outcome.TIP_UNCERTAIN, f'tip sigma {sigma * 1000:.2f} mm exceeds {limit * 1000:.2f} mm'
    return None


def curvature_limit(config: Config, metres_per_px: float) -> float:
    """1/m: `max_curvature`, or the paper's rule (eq. 3): epsilon = spacing (px) x resolution (mm/px), read in 1/mm."""
    return config.plausibility.max_curvature or 1000.0 * config.detection.spacing_px * 1000.0 * metres_per_px


def check_curvature(curves: list[np.ndarray], limit: float) -> tuple[Outcome, str] | None:
    """Eq. 3 of Burgner et al. 2011 on (N, 3) control points of each estimate: None, or the rejection."""
    worst = max((float(curvature(c).max(initial=0.0)) for c in curves), default=0.0)
    if worst > limit:
        return Outcome.CURVATURE, f'curvature {worst:.0f} /m exceeds {limit:.0f} /m'
    return None


def check_length(length: float, config: Config) -> tuple[Outcome, str] | None:
    """Length in m against `expected_length`: None, or the rejection."""
    bounds = config.plausibility.expected_length
    if bounds and not bounds[0] <= length <= bounds[1]:
        return Outcome.LENGTH, f'length {length * 1000:.1f} mm is outside [{bounds[0] * 1000:.1f}, {bounds[1] * 1000:.1f}] mm'
    return None


def check_reprojection(residuals_px: np.ndarray, config: Config) -> tuple[Outcome, str] | None:
    """Median of the (N, 2) residuals of each plane: None, or the rejection."""
    worst = max((float(middle(r[np.isfinite(r)])) for r in residuals_px.T if np.isfinite(r).any()), default=float('nan'))
    if worst > config.plausibility.max_reprojection_px:
        return Outcome.REPROJECTION, f'median reprojection residual {worst:.1f} px exceeds {config.plausibility.max_reprojection_px:g} px'
    return None
