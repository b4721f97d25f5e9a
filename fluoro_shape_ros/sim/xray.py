"""The X-ray renderer: Beer-Lambert attenuation along the path through the tube, focal blur, quantum noise.

The tube is a volume here, cut into small samples that each carry their share; whatever lies along a ray adds up. So foreshortening,
crossings and the flat ends need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..data import View
from ..geometry import depth, project, source
from .carm import finest_pitch, shadow_box

SUPERSAMPLING = 3
CHORD_CUTS = 4


@dataclass(frozen=True)
class Exposure:
    """How an image is taken."""

    photons: float = 1500.0     # a pixel, detected, in the unattenuated beam
    contrast: float = 0.25      # of the device where the beam crosses its axis at a right angle: 1 - exp(-mu * 2 r)
    blur_px: float = 0.7        # sigma of focal spot and detector
    depth: int = 8              # bits; above 8 the image is uint16
    white: float = 0.95         # of full scale that the unattenuated beam reaches

    def __post_init__(self):
        if not 0 < self.contrast < 1 or not self.photons > 0 or not 1 <= self.depth <= 16:
            raise ValueError(f'no exposure: contrast {self.contrast:g}, {self.photons:g} photons, {self.depth} bits')

    def attenuation(self, radius: float) -> float:
        """mu of the device's material, 1/m."""
        return -np.log1p(-self.contrast) / (2 * radius)


def path_length(backbone: np.ndarray, radius: float, view: View) -> np.ndarray:
    """(H, W) float32: the mean length in m of the X-rays' way through the tube of `radius` m, over each pixel.

    A volume dV at depth z spreads over the image as L du dv = dV f^2 / (z^2 cos(alpha)), alpha the ray's angle to the axis.
    """
    image = np.zeros((view.height, view.width), np.float32)
    box = shadow_box(view, backbone, radius)
    if box is None:
        return image
    low, high = box
    eye = source(view.P)
    points, volumes = _samples(backbone, radius, eye, finest_pitch(view, backbone) / SUPERSAMPLING)
    f2 = abs(np.linalg.det(view.P[:, :3]))      # det K, since K[2, 2] = 1 and P is normalised
    ray = points - eye
    weights = volumes * f2 * np.sqrt(np.einsum('ni,ni->n', ray, ray)) / depth(view.P, points)**3
    uv = (project(view.P, points) - low + 0.5) * SUPERSAMPLING - 0.5
    fine = _splat(uv, weights * SUPERSAMPLING**2, (high - low) * SUPERSAMPLING)
    image[low[1]:high[1], low[0]:high[0]] = cv2.resize(fine, tuple(int(n) for n in high - low), interpolation=cv2.INTER_AREA)
    return image


def transmission(backbone: np.ndarray, radius: float, view: View, exposure: Exposure = Exposure()) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the share of the beam that the device lets through, before any blur."""
    return cv2.exp(path_length(backbone, radius, view) * np.float32(-exposure.attenuation(radius)))


def blurred(beam: np.ndarray, exposure: Exposure) -> np.ndarray:
    """The (H, W) beam as focal spot and detector blur it."""
    return cv2.GaussianBlur(beam, (0, 0), exposure.blur_px) if exposure.blur_px > 0 else beam


def expose(beam: np.ndarray, exposure: Exposure, rng: np.random.Generator | None) -> np.ndarray:
    """(H, W) uint8 or uint16: the image of a (H, W) transmitted beam in [0, 1]; blurred, with quantum noise, or without for rng None."""
    beam = blurred(beam, exposure)
    if rng is not None:
        beam = _quantum_noise(beam, exposure.photons, rng)
    full = 2**exposure.depth - 1
    return np.rint(np.clip(beam * np.float32(exposure.white * full), 0, full)).astype(np.uint8 if exposure.depth <= 8 else np.uint16)


def _quantum_noise(beam: np.ndarray, photons: float, rng: np.random.Generator) -> np.ndarray:
    """`beam` as counted in Poisson-distributed quanta. Above 25 a pixel their law is as good as normal, which is faster to draw."""
    counts = np.maximum(beam, 0) * np.float32(photons)
    noisy = counts + np.sqrt(counts) * rng.standard_normal(beam.shape, dtype=np.float32)
    few = counts < 25
    noisy[few] = rng.poisson(counts[few])
    return noisy / np.float32(photons)


def _samples(backbone: np.ndarray, radius: float, eye: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) points in m that fill the tube, and (M,) their volumes in m^3.

    Discs a `pitch` apart are cut into chords along the ray from `eye`, a `pitch` apart too, and each chord into CHORD_CUTS pieces.
    """
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(backbone, axis=0), axis=1)))
    n = max(2, int(np.ceil(s[-1] / pitch)))
    tangents = np.gradient(backbone, s, axis=0)
    curvatures = np.gradient(tangents, s, axis=0)
    middle = (np.arange(n) + 0.5) * s[-1] / n
    centre, tangent, bend = (np.stack([np.interp(middle, s, c) for c in x.T], axis=1) for x in (backbone, tangents, curvatures))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    never_along = 1e-6 * np.eye(3)[np.abs(tangent).argmin(axis=1)]     # keeps `across` defined where the device points at the source
    across = np.cross(centre - eye + never_along, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    depthwise = np.cross(tangent, across)
    m = max(8, int(np.ceil(2 * radius / pitch)))
    a = radius * ((np.arange(m) + 0.5) / m * 2 - 1)
    half_chord = np.sqrt(radius**2 - a**2)
    b = half_chord[:, None] * ((np.arange(CHORD_CUTS) + 0.5) / CHORD_CUTS * 2 - 1)
    a, share = (np.repeat(x, CHORD_CUTS) for x in (a, half_chord / half_chord.sum() / CHORD_CUTS))
    offsets = a[:, None] * across[:, None] + b.reshape(-1, 1) * depthwise[:, None]
    # Pappus: the inside of a bend holds less of the tube than its outside
    volumes = (1 - np.einsum('nmi,ni->nm', offsets, bend)) * share * (np.pi * radius**2 * s[-1] / n)
    return (centre[:, None] + offsets).reshape(-1, 3), volumes.ravel()


def _splat(uv: np.ndarray, weights: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(h, w) float32: weights (M,) summed at (M, 2) pixels, each shared bilinearly among its four; what falls outside is lost."""
    w, h = (int(n) for n in size)
    low = np.floor(uv)
    u, v = low.T.astype(np.int32) + 1       # a border of one pixel takes what falls outside
    inside = (u >= 0) & (v >= 0) & (u <= w) & (v <= h)
    at = np.where(inside, v * (w + 2) + u, 0)
    du, dv = (uv - low).T
    weights = weights * inside
    right, down = weights * du, weights * dv
    both = right * dv
    fine = np.bincount(np.concatenate([at, at + 1, at + w + 2, at + w + 3]),
                       np.concatenate([weights - right - down + both, right - both, down - both, both]), (h + 2) * (w + 2))
    return fine.reshape(h + 2, w + 2)[1:-1, 1:-1].astype(np.float32)
