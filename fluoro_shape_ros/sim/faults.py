"""What comes between a device and its image in a stream: another wire, contrast medium, a plane without X-rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import View
from ..device import REST, Device, Segment
from . import anatomy, shapes, xray
from .motion import Motion

BEGINS_S = 0.3, 0.8         # a dark plane, a bolus
DARK_S, BOLUS_S = 1.0, 2.0
COMES, FADES = 0.15, 0.6    # shares of BOLUS_S: by when it is there, and from when it is washed out
BOLUS_DEPTH = 0.3, 0.8      # optical depth at the most
BOLUS_REACH = 0.15, 0.3     # sigma of the part that it darkens, share of the field's width
VESSELS = 8
MEETS_S = 0.6, 1.4          # the other wire and the device
WHERE = 0.3, 0.9            # share of the device, base to tip
RADII = 0.2e-3, 0.35e-3     # m, of the other wire
SPEED = 0.02, 0.04          # m/s
LENGTH, CURVATURE = 0.6, 8.0        # m, 1/m: both of its ends stay out of the field
MOVES_S = 4.0               # before and after they meet; else it lies still
STEP = 5e-4                 # m


@dataclass(frozen=True, eq=False)
class Wire:
    """Another wire, that is moved across the field as it is."""

    curve: np.ndarray           # (N, 3) m, where it meets the device
    velocity: np.ndarray        # (3,) m/s
    meets_s: float              # when it does
    device: Device

    def at(self, t: float) -> np.ndarray:
        """(N, 3) m at `t` s."""
        return self.curve + self.velocity * np.clip(t - self.meets_s, -MOVES_S, MOVES_S)

    def depth(self, t: float, view: View, energy_kev: float) -> np.ndarray:
        """(H, W) float32: the optical depth that it adds at `t` s."""
        return xray.optical_depth(self.at(t), self.device, view, energy_kev)


@dataclass(frozen=True, eq=False)
class Bolus:
    """Contrast medium that comes and is washed out within BOLUS_S."""

    depths: tuple[np.ndarray, np.ndarray]       # (H, W) float32 optical depth of each plane at the most
    begins_s: float

    def share(self, t: float) -> float:
        """Of `depths`, at `t` s."""
        return float(np.interp((t - self.begins_s) / BOLUS_S, [0.0, COMES, FADES, 1.0], [0.0, 1.0, 1.0, 0.0]))


@dataclass(frozen=True)
class Dark:
    """Plane 0 (A) or 1 (B) gets no X-rays from `begins_s` for DARK_S."""

    plane: int
    begins_s: float

    def at(self, t: float) -> bool:
        """Whether it is dark at `t` s."""
        return self.begins_s <= t < self.begins_s + DARK_S


def draw_wire(rng: np.random.Generator, motion: Motion) -> Wire:
    """One that comes from aside and passes through a point of the moving device."""
    meets_s = float(rng.uniform(*MEETS_S))
    points, curve = motion.backbone(meets_s), shapes.random_spline(rng, LENGTH, CURVATURE).backbone(STEP)
    middle = len(curve) // 2
    aside = np.cross(curve[middle + 1] - curve[middle - 1], rng.normal(size=3))
    velocity = aside / np.linalg.norm(aside) * rng.uniform(*SPEED)
    met = points[int(len(points) * rng.uniform(*WHERE))]
    return Wire(curve - curve[middle] + met, velocity, meets_s,
                Device((Segment(REST, float(rng.uniform(*RADII)), 'metal'),)))


def draw_bolus(rng: np.random.Generator, views: tuple[View, View]) -> Bolus:
    """One that fills the vessels about a place in the middle of the field."""
    return Bolus(tuple(_filled(rng, view) for view in views), float(rng.uniform(*BEGINS_S)))


def draw_dark(rng: np.random.Generator) -> Dark:
    return Dark(int(rng.integers(2)), float(rng.uniform(*BEGINS_S)))


def _filled(rng: np.random.Generator, view: View) -> np.ndarray:
    """(H, W) float32 optical depth of vessels."""
    h, w = view.height, view.width
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    place, reach = rng.uniform(0.3, 0.7, 2) * [w, h], rng.uniform(*BOLUS_REACH) * w
    near = np.exp(-((u - place[0])**2 + (v - place[1])**2) / (2 * reach**2))
    depth = -np.log(anatomy.vessels(rng, (h, w), VESSELS)) * near
    return (depth * (rng.uniform(*BOLUS_DEPTH) / max(depth.max(), 1e-6))).astype(np.float32)
