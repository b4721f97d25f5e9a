"""Whether a reconstruction may be believed; every doubt has a name."""

from __future__ import annotations

import numpy as np

from .config import Config
from .curve import curvature
from .data import Outcome


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
    worst = float(np.nanmedian(residuals_px, axis=0).max())
    if worst > config.plausibility.max_reprojection_px:
        return Outcome.REPROJECTION, f'median reprojection residual {worst:.1f} px exceeds {config.plausibility.max_reprojection_px:g} px'
    return None
