"""How a device moves in a stream: round after round it advances and withdraws once, bends twice, and a load pushes its
tip to and fro three times."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from . import placement, shapes
from .kinematics import loaded

STEP_M = 4e-3               # from pair to pair at most, of the tip: 60 mm/s at 15 pairs a second
PEAK = 0.5, 0.98            # share of that which a tip reaches
SWING = 0.004, 0.012        # m, to either side, of the tip of a straight device of that length
ROOM_PX = 12.0              # between the moving device and the field's border
MOMENTS, LOOKS = 120, 24    # of a round, that its speed is taken from, and that are looked at
COARSE = 2e-3               # m, steps of a backbone that is not drawn


@dataclass(frozen=True, eq=False)
class Motion:
    """Of a shape whose base stays where it is."""

    shape: shapes.Spline | shapes.Cannula       # as far out and as bent as it gets
    load: np.ndarray                            # (3,) force over bending stiffness, 1/m^2
    phases: tuple[float, float, float]          # rad: of sliding, bending, swinging
    rounds: float = 1.0                         # a second

    def backbone(self, t: float, step: float = shapes.STEP) -> np.ndarray:
        """(N, 3) m, base to tip, at `t` s, without a shaft."""
        turn = 2 * np.pi * self.rounds * t
        slide, bend = ((1 - np.cos(n * turn + phase)) / 2 for n, phase in zip((1, 2), self.phases))
        return loaded(shapes.posed(self.shape, slide, bend).backbone(step),
                      self.load * np.sin(3 * turn + self.phases[2]))

    def one_round(self, moments: int) -> list[np.ndarray]:
        """So many coarse backbones, evenly in time."""
        return [self.backbone(k / moments / self.rounds, COARSE) for k in range(moments)]


def draw(rng: np.random.Generator, shape: shapes.Spline | shapes.Cannula) -> Motion:
    """A motion of a second a round."""
    points = shape.backbone(COARSE)
    aside = np.cross(points[-1] - points[-2], rng.normal(size=3))
    load = aside / np.linalg.norm(aside) * 3 * rng.uniform(*SWING) / shape.length**3     # F L^3 / (3 E I)
    return Motion(shape, load, tuple(rng.uniform(0, 2 * np.pi, 3)))


def paced(rng: np.random.Generator, motion: Motion, rate: float) -> Motion:
    """The same motion, so fast that its tip, where it is fastest, goes a drawn share of STEP_M in a pair at `rate`
    pairs a second."""
    tips = np.array([points[-1] for points in motion.one_round(MOMENTS)])
    longest = np.linalg.norm(np.roll(tips, -1, axis=0) - tips, axis=1).max() * MOMENTS      # m a round
    return dataclasses.replace(motion, rounds=float(rng.uniform(*PEAK)) * STEP_M * rate / longest)


def stays_inside(motion: Motion, fields: tuple[placement.Field, placement.Field]) -> bool:
    """Whether both fields hold all of the motion, and see the depth of the device throughout."""
    views = tuple(f.view for f in fields)
    return all(min(f.room(points).min() for f in fields) >= ROOM_PX
               and placement.well_seen(points, views, placement.HARD_EPIPOLAR_SHARE)
               for points in motion.one_round(LOOKS))
