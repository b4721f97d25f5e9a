"""How far a reconstructed backbone lies from the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .geometry.curve import arc_length, distance_to, resample

DENSE = 0.05e-3     # m: both curves are sampled this finely


@dataclass(frozen=True)
class Errors:
    """All in metres."""

    mean: float         # mean distance of the reconstructed curve to the closest point of the true one
                        # (the paper's measure)
    missed: float       # the same the other way round: truth that was not reconstructed shows here
    worst: float        # largest of both directions (Hausdorff)
    tip: float          # distance of the tips
    length: float       # |difference of the lengths|
    matched: float      # mean distance at equal arc length from the tip, over the common length


def compare(points: np.ndarray, truth: np.ndarray) -> Errors:
    """Errors of (N, 3) backbone points against the (M, 3) true backbone, both base to tip, m."""
    found, true = _dense(points), _dense(truth)
    to_true, to_found = distance_to(found, true), distance_to(true, found)
    n = min(len(found), len(true))
    return Errors(float(to_true.mean()), float(to_found.mean()), float(max(to_true.max(), to_found.max())),
                  float(np.linalg.norm(found[-1] - true[-1])), abs(float(arc_length(found)[-1] - arc_length(true)[-1])),
                  float(np.linalg.norm(found[-n:] - true[-n:], axis=1).mean()))


def _dense(points: np.ndarray) -> np.ndarray:
    """A smooth curve through the points in steps of DENSE counted from the tip, so that equal indices from the end are
    equal arc lengths from the tip; only the first step, at the base, may be shorter."""
    return resample(points[::-1], DENSE)[0][::-1]


def surprise(error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared Mahalanobis distance of a (3,) error under its reported (3, 3) covariance: chi-squared with three degrees
    of freedom where the report is honest. NaN where the covariance is not known, inf where it leaves no room for the
    error."""
    if not np.isfinite(covariance).all():
        return float('nan')
    variances, axes = np.linalg.eigh(covariance)
    with np.errstate(divide='ignore', invalid='ignore'):
        terms = (error @ axes)**2 / np.maximum(variances, 0.0)
    return float(np.nan_to_num(terms, nan=0.0, posinf=np.inf).sum())
