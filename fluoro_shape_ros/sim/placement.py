"""Where a random device stands: inside both fields, and turned so that two views can see its depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ..data import View
from ..geometry.cameras import epipolar_lines, fundamental, project, source
from . import shapes

MARGIN_PX = 40                          # between the device and the field's border
MIN_RAY_ANGLE = np.deg2rad(20)          # of the device's tangent to either viewing ray, everywhere
MIN_EPIPOLAR_ANGLE = np.deg2rad(20)     # of the projected device to its epipolar line ...
MIN_EPIPOLAR_SHARE = 0.8                # ... over this share of its length
HARD_EPIPOLAR_SHARE = 0.5               # ... which suffices for a shape that is meant to be hard
CLEAR = 0.010                           # m of device on both sides of a turn or crossing
LONGEST_SHAFT = 0.6                     # m
ATTEMPTS = 5000


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
        lit = self.room_px[np.clip(np.rint(v), 0, self.view.height - 1).astype(int),
                           np.clip(np.rint(u), 0, self.view.width - 1).astype(int)]
        return np.where(edge > 0, np.minimum(edge, lit - 0.5), edge)


def lit_field(view: View, aperture: np.ndarray | None) -> Field:
    """The field of a view behind an `aperture` (H, W), the share of the beam that blades and intensifier let
    through."""
    if aperture is None:
        return Field(view)
    return Field(view, cv2.distanceTransform((aperture > 0.5).astype(np.uint8), cv2.DIST_L2, 5))


def place(rng: np.random.Generator, fields: tuple[Field, Field], kind: str, lengths: tuple[float, float],
          entering: bool) -> tuple:
    """A random shape that two fields see well, and the length in m of the straight shaft behind it (0 unless
    `entering`).

    Draws until the shape suits its kind, stands MARGIN_PX inside both fields wherever it moves, and, when `entering`,
    until its shaft leaves both. Raises ValueError where no such shape turns up.
    """
    if kind not in KINDS:
        raise ValueError(f'no shape is called {kind!r}: there are {", ".join(KINDS)}')
    views = tuple(f.view for f in fields)
    make, suits = KINDS[kind]
    for _ in range(ATTEMPTS):
        shape = make(rng, rng.uniform(*lengths), views)
        if not suits(shape.backbone(2e-3), views) or not _stays_inside(shape, fields):
            continue
        if not entering:
            return shape, 0.0
        shaft = _shaft_to_border(shape, fields)
        if shaft and suits(seen_in_both(with_shaft(shape.backbone(2e-3), shaft), fields), views):
            return shape, shaft
    raise ValueError(f'no {kind} of {lengths[0] * 1000:g} to {lengths[1] * 1000:g} mm fits well into both fields '
                     f'({ATTEMPTS} tried)')


def well_seen(points: np.ndarray, views: tuple[View, View], share: float = MIN_EPIPOLAR_SHARE) -> bool:
    """Whether (N, 3) points keep off both viewing rays, and `share` of them off their epipolar lines."""
    for view, other in (views, views[::-1]):
        steps, middles = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
        ray = middles - source(view.P)
        along = np.abs(np.einsum('ni,ni->n', steps, ray)) / np.linalg.norm(steps, axis=1) / np.linalg.norm(ray, axis=1)
        if along.max() > np.cos(MIN_RAY_ANGLE):
            return False
        if np.mean(np.abs(_across(points, view, other)) > np.sin(MIN_EPIPOLAR_ANGLE)) < share:
            return False
    return True


def turns_back(points: np.ndarray, views: tuple[View, View]) -> bool:
    """Whether (N, 3) points, else seen well enough, turn back in the pencil of epipolar planes: there both images are
    tangent to their epipolar lines, and beside it the lines meet the device twice."""
    rising = _across(points, *views) > 0
    aside = _clear_steps(points)
    steady = [len(set(rising[k:k + aside])) == 1 for k in range(len(rising) - aside + 1)]
    turns = any(steady[k] and steady[k + aside] and rising[k] != rising[k + aside] for k in range(len(steady) - aside))
    return turns and well_seen(points, views, HARD_EPIPOLAR_SHARE)


def crosses_itself(points: np.ndarray, views: tuple[View, View]) -> bool:
    """Whether (N, 3) points, else seen well enough, cross themselves in either image, not near an end."""
    aside = _clear_steps(points)
    return (any(_crosses(project(v.P, points[aside:-aside])) for v in views)
            and well_seen(points, views, HARD_EPIPOLAR_SHARE))


def _across(points: np.ndarray, view: View, other: View) -> np.ndarray:
    """(N - 1,) sine of the signed angle between the projected steps of (N, 3) points and their epipolar lines."""
    lines = epipolar_lines(fundamental(other.P, view.P), project(other.P, (points[1:] + points[:-1]) / 2))
    uv = np.diff(project(view.P, points), axis=0)
    return np.einsum('ni,ni->n', uv, lines[:, :2]) / np.linalg.norm(uv, axis=1)


def _clear_steps(points: np.ndarray) -> int:
    """How many of the equal steps of (N, 3) points CLEAR is."""
    return int(np.ceil(CLEAR / np.linalg.norm(points[1] - points[0])))


def _crosses(uv: np.ndarray) -> bool:
    """Whether two segments of the (N, 2) polyline intersect that do not share a point."""
    a, d = uv[:-1], np.diff(uv, axis=0)
    cross = d[:, None, 0] * d[None, :, 1] - d[:, None, 1] * d[None, :, 0]
    gap = a[None] - a[:, None]
    with np.errstate(divide='ignore', invalid='ignore'):
        # along the row's segment; along the column's: its transpose
        t = (gap[..., 0] * d[None, :, 1] - gap[..., 1] * d[None, :, 0]) / cross
    return bool(np.triu((t >= 0) & (t <= 1) & (t.T >= 0) & (t.T <= 1), 2).any())


def _spline(rng: np.random.Generator, length: float, views) -> shapes.Spline:
    return shapes.random_spline(rng, length)


def _cannula(rng: np.random.Generator, length: float, views) -> shapes.Cannula:
    return shapes.random_cannula(rng, length)


def _bent(rng: np.random.Generator, length: float, views) -> shapes.Spline:
    """A curve that may hook back on itself, with bends of a radius from 12 mm on."""
    return shapes.random_spline(rng, length, rng.uniform(0.5, 2.0) * shapes.MAX_CURVATURE, np.deg2rad(150))


def _hooked(rng: np.random.Generator, length: float, views) -> shapes.Cannula:
    return shapes.random_hook(rng, length)


def _looped(rng: np.random.Generator, length: float, views) -> shapes.Spline:
    """A loose turn of a screw, as a catheter loops, with its axis near one of the viewing directions; it bends as tight
    as other shapes do."""
    knots = np.arange(max(4, int(np.ceil(length / shapes.KNOT_SPACING)) + 1))
    pitch = rng.uniform(0.4, 0.7) + rng.normal(0, 0.05, len(knots))
    yaw = shapes.MAX_CURVATURE * shapes.KNOT_SPACING * knots + rng.normal(0, 0.05, len(knots))
    loop = shapes.Spline(length, np.c_[yaw, pitch])
    s = np.linspace(0.0, length, 500)
    tightest = np.hypot(*(loop.angles()(s, 1) * np.c_[np.cos(loop.angles()(s)[:, 1]), np.ones(500)]).T).max()
    loop = shapes.centred(rng, shapes.Spline(length, np.c_[yaw * shapes.MAX_CURVATURE / tightest, pitch]))
    axis, beam = loop.pose.heading[:, 2], views[rng.integers(2)].P[2, :3] + rng.normal(0, 0.3, 3)
    about = np.cross(axis, beam)
    turn = Rotation.from_rotvec(about / np.linalg.norm(about)
                                * np.arctan2(np.linalg.norm(about), axis @ beam)).as_matrix()
    return dataclasses.replace(loop, pose=shapes.Pose(turn @ loop.pose.base, turn @ loop.pose.heading))


# how a kind of shape is drawn for two views, and what its (N, 3) points must suit in them
KINDS: dict[str, tuple[Callable, Callable]] = {
    'spline': (_spline, well_seen),
    'cannula': (_cannula, well_seen),
    'bent': (_bent, well_seen),
    'hooked': (_hooked, well_seen),
    'tangent': (_spline, turns_back),
    'crossing': (_looped, crosses_itself),
}


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
    """m of straight shaft that lead from the base out of both images; 0 where LONGEST_SHAFT does not, or comes near a
    source."""
    line = with_shaft(shape.backbone(1e-3)[:2], LONGEST_SHAFT)
    if min((line @ f.view.P[2, :3] + f.view.P[2, 3]).min() for f in fields) < 0.1:
        return 0.0
    outside = [project(f.view.P, line) for f in fields]
    beyond = [((uv < -MARGIN_PX) | (uv > [f.view.width + MARGIN_PX, f.view.height + MARGIN_PX])).any(axis=1)
              for uv, f in zip(outside, fields)]
    both = np.flatnonzero(beyond[0] & beyond[1])
    return float(np.linalg.norm(line[both[-1]] - line[-2])) if len(both) else 0.0
