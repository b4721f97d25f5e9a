"""Continuum robots that joints move: concentric tubes and a tendon-driven segment, both chains of arcs, and what a load
at the tip does to them.

Joint values q are an (n,) array in the order of `joints`, m and rad. In a robot's own frame it leaves its base at the
origin along +x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from .shapes import STEP, Pose, Section, chain

COARSE = 5e-3       # m: arcs are exact, so a backbone in coarse steps has the same tip


@dataclass(frozen=True)
class Joint:
    """What an actuator can do."""

    name: str
    low: float      # m or rad
    high: float
    speed: float    # m/s or rad/s, at most


@dataclass(frozen=True)
class Tube:
    """A straight tube whose last part is precurved."""

    stiffness: float    # E I in N m^2
    curvature: float    # 1/m, of the curved part alone
    curved: float       # m, its length


@dataclass(frozen=True)
class TubeRobot:
    """Concentric tubes, the outermost first; torsionally rigid, without friction, in sections of constant curvature.

    R. J. Webster III, J. M. Romano, N. J. Cowan, Mechanics of Precurved-Tube Continuum Robots, IEEE Transactions on
    Robotics 25(1), 2009. q: how far each tube reaches beyond the one around it (the first: beyond the base), m, then
    the rotation of each about the base tangent, rad.
    """

    tubes: tuple[Tube, ...]
    pose: Pose = field(default_factory=Pose)

    @property
    def joints(self) -> tuple[Joint, ...]:
        reach = tuple(Joint(f'reach_{k + 1}', 0.004, 0.1, 0.02) for k in range(len(self.tubes)))
        return reach + tuple(Joint(f'rotation_{k + 1}', -2 * np.pi, 2 * np.pi, 1.0) for k in range(len(self.tubes)))

    def sections(self, q: np.ndarray) -> list[Section]:
        """Pieces between the places where a tube ends or begins to be curved; in each the bending moments of its tubes
        balance."""
        n = len(self.tubes)
        ends, rotation = np.cumsum(q[:n]), q[n:]
        begins = np.maximum(ends - [tube.curved for tube in self.tubes], 0.0)
        stiffness, curvature = np.array([(tube.stiffness, tube.curvature) for tube in self.tubes]).T
        cuts = np.unique(np.concatenate([[0.0], begins, ends]))
        pieces = []
        for start, stop in zip(cuts, cuts[1:]):
            there, bent = ends >= stop, (ends >= stop) & (begins <= start)
            bend = (stiffness * curvature * bent) @ np.c_[np.cos(rotation), np.sin(rotation)] / stiffness[there].sum()
            pieces.append(Section(stop - start, float(np.hypot(*bend)), float(np.arctan2(bend[1], bend[0]))))
        return pieces

    def backbone(self, q: np.ndarray, step: float = STEP) -> np.ndarray:
        """(N, 3) m, base to tip, in the reference frame."""
        return self.pose.apply(chain(self.sections(np.asarray(q, float)), step))

    def misjudged(self, share: float) -> TubeRobot:
        """A robot whose tubes are more curved by `share`, and whose outermost one is that much less stiff, than this
        one's."""
        tubes = [dataclasses.replace(tube, curvature=tube.curvature * (1 + share)) for tube in self.tubes]
        tubes[0] = dataclasses.replace(tubes[0], stiffness=tubes[0].stiffness * (1 - share))
        return dataclasses.replace(self, tubes=tuple(tubes))


@dataclass(frozen=True)
class TendonRobot:
    """A stiff shaft that carries a segment which two pairs of antagonistic tendons bend to a circular arc.

    R. J. Webster III, B. A. Jones, Design and Kinematic Modeling of Constant Curvature Continuum Robots: A Review, IJRR
    29(13), 2010: a tendon at distance d from the axis, pulled by p in the bending plane, turns the tip by p / d.
    q: reach of the shaft (m), its rotation (rad), pull of each pair (m).
    """

    length: float       # m, of the segment
    spread: float       # m, distance of the tendons from the axis
    pose: Pose = field(default_factory=Pose)
    gain: float = 1.0   # turn that the tip takes of p / d: less where tendons stretch or rub

    @property
    def joints(self) -> tuple[Joint, ...]:
        most = 1.8 * self.spread    # the tip turns by some 100 degrees
        return (Joint('reach', 0.004, 0.1, 0.02), Joint('rotation', -2 * np.pi, 2 * np.pi, 1.0),
                Joint('pull_y', -most, most, self.spread), Joint('pull_z', -most, most, self.spread))

    def sections(self, q: np.ndarray) -> list[Section]:
        """The shaft and the bent segment."""
        reach, rotation, y, z = map(float, q)
        turn = self.gain * np.hypot(y, z) / self.spread
        return [Section(reach, 0.0, 0.0), Section(self.length, turn / self.length, rotation + float(np.arctan2(z, y)))]

    def backbone(self, q: np.ndarray, step: float = STEP) -> np.ndarray:
        """(N, 3) m, base to tip, in the reference frame."""
        return self.pose.apply(chain(self.sections(q), step))

    def misjudged(self, share: float) -> TendonRobot:
        """A robot that bends less by `share` than this one."""
        return dataclasses.replace(self, gain=self.gain * (1 - share))


def jacobian(robot: TubeRobot | TendonRobot, q: np.ndarray) -> np.ndarray:
    """(3, n) how the tip moves with each joint, m a unit: central differences."""
    steps = np.array([1e-4 * (joint.high - joint.low) for joint in robot.joints])
    tips = [[robot.backbone(q + sign * d, COARSE)[-1] for sign in (1, -1)] for d in np.diag(steps)]
    return np.stack([(ahead - behind) / (2 * h) for h, (ahead, behind) in zip(steps, tips)], axis=1)


def reaching(robot: TubeRobot | TendonRobot, tip: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(n,) joint values, found from q on, at which a robot's tip is as near as it gets to (3,) `tip`, m: damped least
    squares within the limits."""
    speed = np.array([joint.speed for joint in robot.joints])
    for _ in range(60):
        error = tip - robot.backbone(q, COARSE)[-1]
        J = jacobian(robot, q) * speed
        step = speed * (J.T @ np.linalg.solve(J @ J.T + 0.001**2 * np.eye(3),
                                              error * min(1.0, 0.005 / max(float(np.linalg.norm(error)), 1e-9))))
        q = limited(robot.joints, q + step)
    return q


def limited(joints: Sequence[Joint], q: np.ndarray) -> np.ndarray:
    """(n,) joint values within their limits."""
    return np.clip(q, [joint.low for joint in joints], [joint.high for joint in joints])


def driven(joints: Sequence[Joint], q: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
    """(n,) where joints at `q` are `seconds` after a `command`: no joint moves faster than it can, or beyond its
    limits."""
    reach = np.array([joint.speed for joint in joints]) * seconds
    return q + np.clip(limited(joints, command) - q, -reach, reach)


def loaded(points: np.ndarray, load: np.ndarray) -> np.ndarray:
    """(N, 3) the backbone (N, 3) bent by a force at its tip: smooth, and no longer or shorter than before.

    load: (3,) force over bending stiffness, 1/m^2, in the reference frame. Kirchhoff's rod to first order: the moment
    (tip - x) x F of the unloaded shape turns the tangents; the tip of a straight rod of length L goes aside by F L^3 /
    (3 E I).
    """
    steps = np.diff(points, axis=0)
    s = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    turn = cumulative_trapezoid(np.cross(points[-1] - points, load), s, axis=0, initial=0.0)
    turned = Rotation.from_rotvec((turn[1:] + turn[:-1]) / 2).apply(steps)
    return np.concatenate([points[:1], points[0] + np.cumsum(turned, axis=0)])
