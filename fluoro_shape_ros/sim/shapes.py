"""Robot shapes with known backbones: random smooth splines and a two-tube active cannula, still or moving.

A shape is a frozen set of parameters. Its `backbone()` is the (N, 3) curve in the reference frame, m, base to tip, in
equal arc-length steps, the last point exactly the tip. In the shape's own frame the base is the origin and its tangent
is +x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

STEP = 1e-4             # m, arc-length step of a backbone
MAX_CURVATURE = 40.0    # 1/m: no bend tighter than a radius of 25 mm
HOOK_CURVATURE = 160.0  # 1/m: of a hook's end
KNOT_SPACING = 0.025    # m of arc between the directions a random spline is drawn through


@dataclass(frozen=True)
class Pose:
    """Where a shape's base stands in the reference frame."""

    base: np.ndarray = field(default_factory=lambda: np.zeros(3))       # (3,) m
    heading: np.ndarray = field(default_factory=lambda: np.eye(3))      # (3, 3) rotation, shape to reference frame

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the shape's own frame in the reference frame."""
        return points @ self.heading.T + self.base


@dataclass(frozen=True)
class Section:
    """A piece of constant curvature; it bends in the plane at `rotation` about the tangent of the whole curve's
    base."""

    length: float       # m
    curvature: float    # 1/m, 0: straight
    rotation: float     # rad


@dataclass(frozen=True)
class Spline:
    """A smooth curve whose direction (yaw, pitch) is a cubic spline of arc length."""

    length: float                           # m
    bends: np.ndarray                       # (K, 2) yaw and pitch at knots KNOT_SPACING apart, rad
    pose: Pose = field(default_factory=Pose)

    def angles(self) -> CubicSpline:
        """Arc length (m) to yaw and pitch (rad)."""
        return CubicSpline(np.arange(len(self.bends)) * KNOT_SPACING, self.bends)

    def backbone(self, step: float = STEP) -> np.ndarray:
        """(N, 3) m. The tangent is a unit vector by construction, so arc length is exact; its integral is the curve."""
        s = _steps(self.length, step)
        yaw, pitch = self.angles()(s).T
        tangent = np.c_[np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
        return self.pose.apply(CubicSpline(s, tangent).antiderivative()(s))


@dataclass(frozen=True)
class Cannula:
    """A two-tube active cannula: the section where both tubes lie, then the inner tube alone; each bends with constant
    curvature.

    Rotations are those of the tubes at the base; equal ones keep the cannula in one plane.
    """

    outer_length: float                     # m
    outer_curvature: float                  # 1/m, 0: straight
    outer_rotation: float                   # rad about the base tangent
    inner_length: float                     # m that the inner tube reaches beyond the outer
    inner_curvature: float                  # 1/m
    inner_rotation: float                   # rad about the base tangent
    pose: Pose = field(default_factory=Pose)

    @property
    def length(self) -> float:
        """Arc length, m."""
        return self.outer_length + self.inner_length

    def backbone(self, step: float = STEP) -> np.ndarray:
        """(N, 3) m, from the closed form of circular arcs."""
        return self.pose.apply(chain([Section(self.outer_length, self.outer_curvature, self.outer_rotation),
                                      Section(self.inner_length, self.inner_curvature, self.inner_rotation)], step))


def chain(sections: Sequence[Section], step: float = STEP) -> np.ndarray:
    """(N, 3) m: sections one after another from the origin along +x, in equal arc-length steps of nearly `step` m.

    The frame slides along each arc without rolling (Bishop), so that it bends about the axis across the bending plane.
    """
    s = _steps(sum(section.length for section in sections), step)
    points, frame, start = np.zeros((len(s), 3)), np.eye(3), 0.0
    for piece in sections:
        points += _arc(np.clip(s - start, 0.0, piece.length), piece.curvature, piece.rotation) @ frame.T
        axis = np.array([0.0, -np.sin(piece.rotation), np.cos(piece.rotation)])
        frame = frame @ Rotation.from_rotvec(axis * piece.curvature * piece.length).as_matrix()
        start += piece.length
    return points


def random_spline(rng: np.random.Generator, length: float, max_curvature: float = MAX_CURVATURE,
                  max_turn: float = np.deg2rad(75)) -> Spline:
    """A robot-like curve of `length` m at a random pose about the origin; it never bends tighter than `max_curvature`
    (1/m).

    Its direction strays at most `max_turn` rad from the base's in yaw and in pitch, so it does not curl up.
    """
    knots = max(4, int(np.ceil(length / KNOT_SPACING)) + 1)
    bends = np.cumsum(rng.normal(size=(knots, 2)), axis=0)
    shape = Spline(length, bends - bends[0])
    s = np.linspace(0.0, length, 500)
    # a bound of the curvature, which is less where the curve is pitched
    tightest = np.hypot(*shape.angles()(s, 1).T).max()
    scale = min(rng.uniform(0.5, 1.0) * max_curvature / tightest, max_turn / np.abs(shape.angles()(s)).max())
    return centred(rng, dataclasses.replace(shape, bends=shape.bends * scale))


def random_cannula(rng: np.random.Generator, length: float, max_curvature: float = MAX_CURVATURE) -> Cannula:
    """A cannula of `length` m at a random pose about the origin, its outer tube straight half of the time."""
    outer = rng.uniform(0.4, 0.7) * length
    outer_curvature = rng.choice([0.0, rng.uniform(0.1, 0.4) * max_curvature])
    return centred(rng, Cannula(outer, float(outer_curvature), rng.uniform(-np.pi, np.pi), length - outer,
                                rng.uniform(0.3, 0.9) * max_curvature, rng.uniform(-np.pi, np.pi)))


def random_hook(rng: np.random.Generator, length: float) -> Cannula:
    """A gently bent shaft whose end is bent tightly, as that of a steerable catheter or a J-tipped wire, of `length` m
    in all, at a random pose about the origin."""
    end = rng.uniform(0.1, 0.4) * length
    tight = min(np.deg2rad(rng.uniform(45.0, 170.0)) / end, HOOK_CURVATURE)
    return centred(rng, Cannula(length - end, rng.uniform(0.0, 0.4) * MAX_CURVATURE, rng.uniform(-np.pi, np.pi), end,
                                float(tight), rng.uniform(-np.pi, np.pi)))


def centred(rng: np.random.Generator, shape, spread: float = 0.005):
    """`shape` in a random attitude, the middle of its bounding box within about `spread` m of the origin."""
    heading = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    points = dataclasses.replace(shape, pose=Pose(heading=heading)).backbone(1e-3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return dataclasses.replace(shape, pose=Pose(rng.normal(0.0, spread, 3) - middle, heading))


def moving(shape: Spline | Cannula, t: float, period: float = 8.0) -> Spline | Cannula:
    """`shape` at `t` s of a slow, periodic motion: it slides out and in, and bends. At t = 0 it is `shape` itself."""
    slide = 0.5 * (1 - np.cos(2 * np.pi * t / period))
    bend = 0.5 * (1 - np.cos(2 * np.pi * t / (0.73 * period)))
    return posed(shape, slide, bend)


def posed(shape: Spline | Cannula, slide: float, bend: float) -> Spline | Cannula:
    """`shape` moved by shares of its motion, both in [0, 1]; it never gets longer or bends tighter than at 0, 0.

    A spline slides back along its own path by a fifth and straightens by 30 %; a cannula draws its inner tube in by two
    fifths and turns it by 0.6 rad.
    """
    if isinstance(shape, Cannula):
        return dataclasses.replace(shape, inner_length=shape.inner_length * (1 - 0.4 * slide),
                                   inner_rotation=shape.inner_rotation + 0.6 * bend)
    return dataclasses.replace(shape, length=shape.length * (1 - 0.2 * slide), bends=shape.bends * (1 - 0.3 * bend))


def _steps(length: float, step: float) -> np.ndarray:
    """(N,) arc lengths 0 .. length in equal steps of nearly `step` m."""
    if not 0 < step <= length:
        raise ValueError(f'a backbone of {length:g} m can not be cut into steps of {step:g} m')
    return np.linspace(0.0, length, round(length / step) + 1)


def _arc(s: np.ndarray, curvature: float, rotation: float) -> np.ndarray:
    """(N, 3) points at arc lengths `s` of a circular arc from the origin along +x, bending in the plane at `rotation`
    about x."""
    half = curvature * s / 2
    forward = s * np.sinc(2 * half / np.pi)                             # sin(ks) / k
    aside = s * np.sin(half) * np.sinc(half / np.pi)                    # (1 - cos(ks)) / k
    return np.c_[forward, aside * np.cos(rotation), aside * np.sin(rotation)]
