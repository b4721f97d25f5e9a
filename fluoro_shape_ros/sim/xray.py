"""The X-ray renderer: Beer-Lambert attenuation along the path through the tube, focal blur, quantum noise.

The tube is a volume here, cut into small samples that each carry their share; whatever lies along a ray adds up. So
foreshortening, crossings and the flat ends need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..data import View
from ..device import Device, attenuation
from ..geometry.cameras import depth, project, source
from ..geometry.curve import arc_length, at_arc_length
from .carm import finest_pitch, shadow_box

SUPERSAMPLING = 3
CHORD_CUTS, MOST_CUTS = 4, 32


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

    A volume dV at depth z spreads over the image as L du dv = dV f^2 / (z^2 cos(alpha)), alpha the ray's angle to the
    axis.
    """
    return _shadow(backbone, view, finest_pitch(view, backbone), radius, [(radius, 0.0, None, 1.0)])


def optical_depth(backbone: np.ndarray, device: Device, view: View, energy_kev: float) -> np.ndarray:
    """(H, W) float32: what a device about the (N, 3) backbone, base to tip, adds to the integral of attenuation along
    the X-rays.

    Raises DeviceError for an energy beyond the tabulated ones, and ValueError where the backbone reaches the source.
    """
    length = arc_length(backbone)[-1]
    alike: dict[tuple, list] = {}       # pieces of one make are drawn in one go
    for piece in device.pieces(length):
        alike.setdefault((piece.radius, piece.lumen, piece.material),
                         []).append((max(0.0, length - piece.stop), length - piece.start))
    parts = [(radius, lumen, between, attenuation(material, energy_kev))
             for (radius, lumen, material), between in alike.items()]
    return _shadow(backbone, view, _shown_pitch(backbone, view, device.widest), device.widest, parts)


def transmission(backbone: np.ndarray, radius: float, view: View, exposure: Exposure = Exposure()) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the share of the beam that the device lets through, before any blur."""
    return cv2.exp(path_length(backbone, radius, view) * np.float32(-exposure.attenuation(radius)))


def blurred(beam: np.ndarray, exposure: Exposure) -> np.ndarray:
    """The (H, W) beam as focal spot and detector blur it."""
    return cv2.GaussianBlur(beam, (0, 0), exposure.blur_px) if exposure.blur_px > 0 else beam


def expose(beam: np.ndarray, exposure: Exposure, rng: np.random.Generator | None) -> np.ndarray:
    """(H, W) uint8 or uint16: the image of a (H, W) transmitted beam in [0, 1]; blurred, with quantum noise, or without
    for rng None."""
    beam = blurred(beam, exposure)
    if rng is not None:
        beam = _quantum_noise(beam, exposure.photons, rng)
    full = 2**exposure.depth - 1
    return np.rint(np.clip(beam * np.float32(exposure.white * full), 0, full)).astype(np.uint8 if exposure.depth <= 8
                                                                                      else np.uint16)


def _quantum_noise(beam: np.ndarray, photons: float, rng: np.random.Generator) -> np.ndarray:
    """`beam` as counted in Poisson-distributed quanta. Above 25 a pixel their law is as good as normal, which is faster
    to draw."""
    counts = np.maximum(beam, 0) * np.float32(photons)
    noisy = counts + np.sqrt(counts) * rng.standard_normal(beam.shape, dtype=np.float32)
    few = counts < 25
    noisy[few] = rng.poisson(counts[few])
    return noisy / np.float32(photons)


def _shown_pitch(backbone: np.ndarray, view: View, widest: float) -> float:
    """As finest_pitch, but where the image shows the backbone: a shaft that comes near the source outside of it asks
    for no finer samples."""
    points = np.concatenate([backbone, at_arc_length(backbone, np.linspace(0.0, arc_length(backbone)[-1], 1000))])
    pitch = finest_pitch(view, points)
    shown = _shown(points, view, widest / pitch + 2)
    return finest_pitch(view, points[shown]) if shown.any() else pitch


def _shadow(backbone: np.ndarray, view: View, pitch: float, widest: float, parts) -> np.ndarray:
    """(H, W) float32: the sum of `parts` of a device no wider than `widest` m, in samples for pixels of a `pitch` in m.
    Each part is a radius and that of its lumen in m, its places along the backbone (see _samples) and its attenuation
    in 1/m (1: the sum is a length in m).
    """
    image = np.zeros((view.height, view.width), np.float32)
    box = shadow_box(view, backbone, widest)
    if box is None:
        return image
    low, high = box
    eye, pitch = source(view.P), pitch / SUPERSAMPLING
    points, volumes = zip(*(_samples(backbone, radius, lumen, view, pitch, between)
                            for radius, lumen, between, _ in parts))
    volumes = np.concatenate([v * mu for v, (*_, mu) in zip(volumes, parts)])
    points = np.concatenate(points)
    f2 = abs(np.linalg.det(view.P[:, :3]))      # det K, since K[2, 2] = 1 and P is normalised
    ray = points - eye
    weights = volumes * f2 * np.sqrt(np.einsum('ni,ni->n', ray, ray)) / depth(view.P, points)**3
    uv = (project(view.P, points) - low + 0.5) * SUPERSAMPLING - 0.5
    fine = _splat(uv, weights * SUPERSAMPLING**2, (high - low) * SUPERSAMPLING)
    image[low[1]:high[1], low[0]:high[0]] = cv2.resize(fine, tuple(int(n) for n in high - low),
                                                       interpolation=cv2.INTER_AREA)
    return image


def _samples(backbone: np.ndarray, radius: float, lumen: float, view: View, pitch: float,
             between: list[tuple[float, float]] | None) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) points in m that fill the tube of `radius` m but for its `lumen` (m radius) where the image shows it, and
    (M,) their volumes in m^3.

    `between` pairs of arc lengths, m from the first point of the (N, 3) backbone; None: all of it. Discs a `pitch`
    apart are cut into chords along the ray from the source, a `pitch` apart too, and each chord into CHORD_CUTS pieces;
    of parts into more where the end of one would show steps of above a pixel, since a ray that is not at a right angle
    to the axis sees them one beside another.
    """
    s, eye = arc_length(backbone), source(view.P)
    tangents = np.gradient(backbone, s, axis=0)
    curvatures = np.gradient(tangents, s, axis=0)
    middle, thick = _discs(between or [(0.0, s[-1])], s[-1], pitch)
    shown = _shown(np.stack([np.interp(middle, s, c) for c in backbone.T], axis=1), view,
                   radius / (pitch * SUPERSAMPLING) + 2)
    middle, thick = middle[shown], thick[shown]
    centre, tangent, bend = (np.stack([np.interp(middle, s, c) for c in x.T], axis=1)
                             for x in (backbone, tangents, curvatures))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # keeps `across` defined where the device points at the source
    never_along = 1e-6 * np.eye(3)[np.abs(tangent).argmin(axis=1)]
    across = np.cross(centre - eye + never_along, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    depthwise = np.cross(tangent, across)
    count = CHORD_CUTS if between is None else _cuts(tangent, centre - eye, radius / (pitch * SUPERSAMPLING))
    m = max(8, int(np.ceil(2 * radius / pitch)))
    a = radius * ((np.arange(m) + 0.5) / m * 2 - 1)
    hollow = np.sqrt(np.maximum(lumen**2 - a**2, 0.0))
    half_chord = np.sqrt(radius**2 - a**2) - hollow
    cuts = (np.arange(count) + 0.5) / count * 2 - 1
    b = half_chord[:, None] * cuts + hollow[:, None] * np.sign(cuts)
    a, share = (np.repeat(x, count) for x in (a, half_chord / half_chord.sum() / count))
    offsets = a[:, None] * across[:, None] + b.reshape(-1, 1) * depthwise[:, None]
    # Pappus: the inside of a bend holds less of the tube than its outside
    volumes = (1 - np.einsum('nmi,ni->nm', offsets, bend)) * share * (np.pi * (radius**2 - lumen**2) * thick)[:, None]
    return (centre[:, None] + offsets).reshape(-1, 3), volumes.ravel()


def _cuts(tangent: np.ndarray, ray: np.ndarray, radius_px: float) -> int:
    """Even number of pieces to cut chords into, so that none is longer than a pixel as the (N, 3) rays see it; from
    CHORD_CUTS to MOST_CUTS."""
    cosine = np.einsum('ni,ni->n', tangent, ray) / np.linalg.norm(ray, axis=1)
    return int(np.clip(2 * np.ceil(radius_px * np.abs(cosine).max(initial=0.0)), CHORD_CUTS, MOST_CUTS))


def _discs(between: list[tuple[float, float]], length: float, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) arc lengths of the middles of discs that fill the pieces, and (N,) their thickness, at most a `pitch`; all
    in m.

    They are the discs of the whole `length`, of which a piece has a share where it begins or ends: so nothing shows
    where two of one make meet.
    """
    n = max(2, int(np.ceil(length / pitch)))
    inside = [np.arange(int(start / length * n), min(int(np.ceil(stop / length * n)), n)) for start, stop in between]
    k = np.concatenate(inside)
    start, stop = np.repeat(between, [len(i) for i in inside], axis=0).T
    thick = np.minimum(stop, (k + 1) * length / n) - np.maximum(start, k * length / n)
    return (k + 0.5) * length / n, np.where(thick > (1 - 1e-6) * length / n, length / n, thick)


def _shown(points: np.ndarray, view: View, margin_px: float) -> np.ndarray:
    """(N,) bool: whether (N, 3) points stand in the image, or within `margin_px` of it."""
    uv = project(view.P, points)
    return ((uv > -margin_px) & (uv < [view.width + margin_px, view.height + margin_px])).all(axis=1)


def _splat(uv: np.ndarray, weights: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(h, w) float32: weights (M,) summed at (M, 2) pixels, each shared bilinearly among its four; what falls outside
    is lost."""
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
                       np.concatenate([weights - right - down + both, right - both, down - both, both]),
                       (h + 2) * (w + 2))
    return fine.reshape(h + 2, w + 2)[1:-1, 1:-1].astype(np.float32)
