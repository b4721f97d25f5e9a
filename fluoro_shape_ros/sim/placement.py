"""Where a random device stands: inside both fields, and turned so that two views can see its depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..data import View
from ..geometry import epipolar_lines, fundamental, project, source
from . import shapes

MARGIN_PX = 40                          # between the device and the field's border
MIN_RAY_ANGLE = np.deg2rad(20)          # of the device's tangent to either viewing ray, everywhere
MIN_EPIPOLAR_ANGLE = np.deg2rad(20)     # of the projected device to its epipolar line ...
MIN_EPIPOLAR_SHARE = 0.8                # ... over this share of its length
LONGEST_SHAFT = 0.6                     # m
ATTEMPTS = 5000

KINDS = {'spline': shapes.random_spline, 'cannula': shapes.random_cannula}


@dataclass(frozen=True)
class Field:
    """A view and how much of its image sees anything."""

    view: View
    room_px: np.ndarray | None = None   # (H, W) float32, distance to the border of the lit field; None: all is lit

    def room(self, points: np.ndarray) -> np.ndarray:
        """(N,) px from the projections of (N, 3) points to the field's border; negative outside the image."""
        u, v = project(self.view.P, points).T
        edge = np.minimum(np.minimum(u, self.view.width - 1 - u), np.minimum(v, self.view.height - 1 - v)) + 0.5
        if self.room_px is None:
            return edge
        lit = self.room_px[np.clip(np.rint(v), 0, self.view.height - 1).astype(int), np.clip(np.rint(u), 0, self.view.width - 1).astype(int)]
        return np.where(edge > 0, np.minimum(edge, lit - 0.5), edge)


def lit_field(view: View, aperture: np.ndarray | None) -> Field:
    """The field of a view behind an `aperture` (H, W), the share of the beam that blades and intensifier let through."""
    if aperture is None:
        return Field(view)
    return Field(view, cv2.distanceTransform((aperture > 0.5).astype(np.uint8), cv2.DIST_L2, 5))


def place(rng: np.random.Generator, fields: tuple[Field, Field], kind: str, lengths: tuple[float, float], entering: bool) -> tuple:
    """A random shape that two fields see well, and the length in m of the straight shaft behind it (0 unless `entering`).

    Draws until the shape is `well_seen`, stands MARGIN_PX inside both fields wherever it moves, and, when `entering`, until its shaft leaves both.
    Raises ValueError where no such shape turns up.
    """
    if kind not in KINDS:
        raise ValueError(f'no shape is called {kind!r}: there are {", ".join(KINDS)}')
    views = tuple(f.view for f in fields)
    for _ in range(ATTEMPTS):
        shape = KINDS[kind](rng, rng.uniform(*lengths))
        if not well_seen(shape.backbone(2e-3), views) or not _stays_inside(shape, fields):
            continue
        if not entering:
            return shape, 0.0
        shaft = _shaft_to_border(shape, fields)
        if shaft and well_seen(seen_in_both(with_shaft(shape.backbone(2e-3), shaft), fields), views):
            return shape, shaft
    raise ValueError(f'no {kind} of {lengths[0] * 1000:g} to {lengths[1] * 1000:g} mm fits well into both fields ({ATTEMPTS} tried)')


def well_seen(points: np.ndarray, views: tuple[View, View]) -> bool:
    """Whether (N, 3) points keep off both viewing rays, and most of them off their epipolar lines."""
    steps, middles = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    for view, other in (views, views[::-1]):
        ray = middles - source(view.P)
        along = np.abs(np.einsum('ni,ni->n', steps, ray)) / np.linalg.norm(ray, axis=1)
        if along.max() > np.cos(MIN_RAY_ANGLE):
            return False
        lines = epipolar_lines(fundamental(other.P, view.P), project(other.P, middles))
        uv = np.diff(project(view.P, points), axis=0)
        across = np.abs(np.einsum('ni,ni->n', uv, lines[:, :2])) / np.linalg.norm(uv, axis=1)     # sine of the angle
        if np.mean(across > np.sin(MIN_EPIPOLAR_ANGLE)) < MIN_EPIPOLAR_SHARE:
            return False
    return True


def with_shaft(backbone: np.ndarray, shaft: float) -> np.ndarray:
    """(N, 3) the backbone with a straight shaft of nearly `shaft` m before its base, in the same steps."""
    step = backbone[1] - backbone[0]
    back = np.arange(round(shaft / np.linalg.norm(step)), 0, -1)
    return np.concatenate([backbone[0] - back[:, None] * step, backbone])


def seen_in_both(backbone: np.ndarray, fields: tuple[Field, Field]) -> np.ndarray:
    """(N, 3) the end of the backbone from where it stands in both fields for good up to the tip."""
    outside = np.flatnonzero(np.minimum(*(f.room(backbone) for f in fields)) < 0)
    return backbone[outside[-1] + 1:] if len(outside) else backbone


def _stays_inside(shape, fields: tuple[Field, Field]) -> bool:
    """Whether both fields hold the shape with MARGIN_PX to spare at all corners of its motion."""
    corners = (shapes.posed(shape, slide, bend).backbone(2e-3) for slide in (0, 1) for bend in (0, 1))
    return all(f.room(points).min() >= MARGIN_PX for points in corners for f in fields)


def _shaft_to_border(shape, fields: tuple[Field, Field]) -> float:
    """m of straight shaft that lead from the base out of both images; 0 where LONGEST_SHAFT does not, or comes near a source."""
    line = with_shaft(shape.backbone(1e-3)[:2], LONGEST_SHAFT)
    if min((line @ f.view.P[2, :3] + f.view.P[2, 3]).min() for f in fields) < 0.1:
        return 0.0
    outside = [project(f.view.P, line) for f in fields]
    beyond = [((uv < -MARGIN_PX) | (uv > [f.view.width + MARGIN_PX, f.view.height + MARGIN_PX])).any(axis=1) for uv, f in zip(outside, fields)]
    both = np.flatnonzero(beyond[0] & beyond[1])
    return float(np.linalg.norm(line[both[-1]] - line[-2])) if len(both) else 0.0
