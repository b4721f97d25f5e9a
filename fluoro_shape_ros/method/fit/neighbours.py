"""Strips without the line beside the device: a lead or a wire that runs along it for a while pulls a fit aside and
spoils the device's profile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ...geometry.curve import middle
from ...imaging.profiles import shadow
from ...imaging.strips import Strips, darkness_across

APART_PX = 2.5          # beyond the device's half width, from its middle to that of the nearest line that can be told
                        # from it
ALONG = 9               # strips over which a line is looked for
FAINT = 0.4             # of the device's darkness: a fainter line does no harm
NARROW, WIDE = 0.7, 1.6     # times as wide as the device: what such lines are made of
STIFF = 1e-6            # keeps the equations solvable where both look alike


def without_neighbours(strips: Strips, half_width_px: Sequence[float], keep_px: float) -> Strips:
    """`strips` cut wide, without the darkest line beside the device in each, and only as far as `keep_px` to either
    side.

    half_width_px: (V,) of the device. Least squares of each strip for a parabola, the device at its place (profile and
    shift) and the other line where it looks darkest (two widths and a shift); what is the other line's is taken away.
    """
    x = strips.offsets_px
    kept = np.abs(x) <= keep_px
    profiles = [_cleared(p, h, x) for p, h in zip(strips.profiles, half_width_px)]
    return replace(strips, profiles=np.stack(profiles)[..., kept], offsets_px=x[kept])


def _cleared(profiles: np.ndarray, half_width: float, x: np.ndarray) -> np.ndarray:
    """(N, W) profiles of one plane at offsets (W,), without the line beside the device."""
    dark = dark_along(profiles, half_width, x)
    usual = max(float(middle(dark[:, len(x) // 2])), 1e-9)
    beside = np.where(np.abs(x) > half_width + APART_PX, dark, -np.inf)
    there = np.nonzero(beside.max(axis=1) > FAINT * usual)[0]
    if len(there) == 0:
        return profiles
    slope = lambda h, y: 0.5 * (shadow(h, y + 1) - shadow(h, y - 1))        # noqa: E731
    moved, u = x - x[beside[there].argmax(axis=1), None], x / x[-1]         # (n, W) from the other line
    own = np.stack([np.ones_like(u), u, u * u, shadow(half_width, x), slope(half_width, x)], axis=-1)
    other = np.stack([shadow(half_width * NARROW, moved), shadow(half_width * WIDE, moved), slope(half_width, moved)],
                     axis=-1)
    A = np.concatenate([np.broadcast_to(own, (len(there), *own.shape)), other], axis=-1)
    T = A.transpose(0, 2, 1)
    amounts = np.linalg.solve(T @ A + STIFF * np.eye(A.shape[-1]), T @ profiles[there][..., None])
    clean = profiles.copy()
    clean[there] -= (other @ amounts[:, own.shape[-1]:])[..., 0]
    return clean


def dark_along(profiles: np.ndarray, half_width: float, x: np.ndarray) -> np.ndarray:
    """(N, W) darkness across (N, W) profiles, averaged along them."""
    return cv2.blur(darkness_across(profiles, shadow(half_width, x[np.abs(x) <= 1.6 * half_width + 3])), (1, ALONG))
