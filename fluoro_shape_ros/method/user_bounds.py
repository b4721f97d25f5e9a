"""What a user has set a bound to, and the paper's rule: each check is None, or the rejection by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..config import Config
from ..data import Outcome
from ..geometry.curve import curvature, middle


def check_tip(covariance: np.ndarray, config: Config) -> tuple[Outcome, str] | None:
    """Standard deviation of the tip in its worst direction, from its (3, 3) covariance in m^2: None, or the
    rejection."""
    limit = config.plausibility.max_tip_sigma
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) if np.isfinite(covariance).all() else float('inf')
    if limit and not sigma <= limit:
        return Outcome.TIP_UNCERTAIN, f'tip sigma {sigma * 1000:.2f} mm exceeds {limit * 1000:.2f} mm'
    return None


def curvature_limit(config: Config, metres_per_px: float) -> float:
    """1/m: `max_curvature`, or the paper's rule (eq. 3): epsilon = spacing (px) x resolution (mm/px), read in 1/mm."""
    return config.plausibility.max_curvature or 1000.0 * config.detection.spacing_px * 1000.0 * metres_per_px


def check_curvature(curves: Sequence[np.ndarray], limit: float) -> tuple[Outcome, str] | None:
    """Eq. 3 of Burgner et al. 2011 on (N, 3) control points of each estimate: None, or the rejection."""
    worst = max((float(curvature(c).max(initial=0.0)) for c in curves), default=0.0)
    if worst > limit:
        return Outcome.CURVATURE, f'curvature {worst:.0f} /m exceeds {limit:.0f} /m'
    return None


def check_length(length: float, config: Config) -> tuple[Outcome, str] | None:
    """Length in m against `expected_length`: None, or the rejection."""
    bounds = config.plausibility.expected_length
    if bounds and not bounds[0] <= length <= bounds[1]:
        return (Outcome.LENGTH, f'length {length * 1000:.1f} mm is outside '
                                f'[{bounds[0] * 1000:.1f}, {bounds[1] * 1000:.1f}] mm')
    return None


def check_reprojection(residuals_px: np.ndarray, config: Config) -> tuple[Outcome, str] | None:
    """Median of the (N, 2) residuals of each plane: None, or the rejection."""
    worst = max((float(middle(r[np.isfinite(r)])) for r in residuals_px.T if np.isfinite(r).any()),
                default=float('nan'))
    if worst > config.plausibility.max_reprojection_px:
        return (Outcome.REPROJECTION, f'median reprojection residual {worst:.1f} px exceeds '
                                      f'{config.plausibility.max_reprojection_px:g} px')
    return None
