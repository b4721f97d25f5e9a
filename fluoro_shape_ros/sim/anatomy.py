"""What else stands in the beam: anatomy-like backgrounds and clutter, as pure functions of a random generator.

Each gives the transmitted share of the beam as a (H, W) float32 image, so that they combine by multiplication. Sizes
scale with the image. Nothing here is meant to be a particular patient; it is meant to be as much in the way as one.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.interpolate import CubicSpline


def anatomy(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Soft tissue, a spine, ribs and vessels: about 0.2 to 0.9."""
    return tissue(rng, shape) * spine(rng, shape) * ribs(rng, shape) * vessels(rng, shape)


def tissue(rng: np.random.Generator, shape: tuple[int, int], octaves: int = 5) -> np.ndarray:
    """Smooth fractal soft tissue: each octave twice as fine and half as strong."""
    small = [max(n // 4, 8) for n in shape]
    depth = np.zeros(small, np.float32)
    for k in range(octaves):
        cells = rng.standard_normal((3 * 2**k, 3 * 2**k), dtype=np.float32)
        depth += cv2.resize(cells, small[::-1], interpolation=cv2.INTER_CUBIC) * 0.5**k
    depth = 0.45 + 0.16 * depth
    return _full(np.exp(-np.maximum(depth, 0.05)), shape)


def ribs(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Arched bands with dense edges: hollow bones across the field."""
    h, w = shape
    gap = rng.uniform(0.16, 0.24) * h
    slope, arch, tilt = rng.uniform(-0.4, 0.4), rng.uniform(-0.25, 0.25), rng.uniform(0.02, 0.05)
    u = np.linspace(-0.1, 1.1, 40)
    depth = np.zeros(_half(shape), np.float32)
    for v0 in np.arange(-0.3 * h + rng.uniform(0, gap), 1.3 * h, gap):
        v = v0 + slope * w * (u - 0.5) + arch * h * (2 * u - 1)**2 + tilt * h * np.sin(7 * u + v0)
        radius = rng.uniform(0.016, 0.024) * w
        depth += _tube_depth(np.c_[u * w, v], radius, 0.78 * radius, shape) * (rng.uniform(0.10, 0.20) / radius)
    return _full(np.exp(-depth), shape)


def spine(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """A column of vertebrae: blocks with dense rims, smooth gaps between them; anywhere across the field."""
    h, w = _half(shape)
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    angle = rng.uniform(-0.25, 0.25)
    x = (u - rng.uniform(0.1, 0.9) * w) * np.cos(angle) + (v - h / 2) * np.sin(angle)
    y = (v - h / 2) * np.cos(angle) - (u - w / 2) * np.sin(angle)
    pitch, half_width = rng.uniform(0.13, 0.18) * h, rng.uniform(0.06, 0.09) * w
    along = np.abs((y / pitch + rng.uniform(0, 1)) % 1 - 0.5) * 2       # 0 in the middle of a vertebra, 1 between two
    waist = half_width * (0.86 + 0.14 * along**2)
    inside = np.minimum(1 - np.abs(x) / waist, (0.9 - along) * 0.5 * pitch / half_width)
    body = 1 / (1 + np.exp(-np.clip(inside * 30, -30, 30)))
    rim = np.exp(-((inside - 0.06) / 0.05)**2)
    return _full(np.exp(-(0.28 * body + 0.16 * rim)), shape)


def vessels(rng: np.random.Generator, shape: tuple[int, int], count: int = 4) -> np.ndarray:
    """Tubes of weak contrast, wider than a device, winding across the field."""
    depth = np.zeros(_half(shape), np.float32)
    for _ in range(count):
        radius = rng.uniform(0.006, 0.02) * shape[1]
        depth += _tube_depth(_winding(rng, shape, 0.25), radius, 0.0, shape) * (rng.uniform(0.02, 0.06) / radius)
    return _full(np.exp(-depth), shape)


def leads(rng: np.random.Generator, shape: tuple[int, int], count: int = 2) -> np.ndarray:
    """ECG leads on the skin: long thin wires, each ending in an electrode's button."""
    beam = np.ones(shape, np.float32)
    for _ in range(count):
        width = rng.uniform(0.0025, 0.004) * shape[1]
        wire = _winding(rng, shape, 0.12)[:rng.integers(90, 160)]
        shadow = np.zeros(shape, np.uint8)
        cv2.polylines(shadow, [np.rint(wire * 16).astype(np.int32)], False, 255, max(1, round(width)), cv2.LINE_AA, 4)
        cv2.circle(shadow, tuple(int(x) for x in np.rint(wire[-1] * 16)), round(5 * width * 16), 255, -1,
                   cv2.LINE_AA, 4)
        beam *= 1 - shadow * np.float32(rng.uniform(0.15, 0.4) / 255)
    return beam


def blades(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Collimator: four straight blades that leave a slightly turned rectangle open; 0.02 behind them."""
    h, w = shape
    left, right, top, bottom = rng.uniform(0.03, 0.12, 4)
    corners = np.array([[left * w, top * h], [(1 - right) * w, top * h], [(1 - right) * w, (1 - bottom) * h],
                        [left * w, (1 - bottom) * h]])
    turn = rng.uniform(-0.03, 0.03)
    middle = np.array([w / 2, h / 2])
    corners = (corners - middle) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + middle
    window = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(window, np.rint(corners * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    return _opening(window, 0.002 * w)


def intensifier(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """The circular field of an image intensifier, darker towards its rim; 0.02 outside."""
    h, w = shape
    radius = rng.uniform(0.46, 0.5) * min(h, w)
    window = np.zeros(shape, np.uint8)
    cv2.circle(window, (w * 8, h * 8), round(radius * 16), 255, -1, cv2.LINE_AA, 4)
    r2 = ((np.arange(h)[:, None] - h / 2)**2 + (np.arange(w) - w / 2)**2) / radius**2
    return _opening(window, 0.001 * w) * (1 - 0.2 * np.minimum(r2, 1)).astype(np.float32)


def occluder(rng: np.random.Generator, shape: tuple[int, int], centre_px: np.ndarray) -> np.ndarray:
    """A dense implant-like plate about `centre_px` (u, v) that lets 5 to 15 % through."""
    w = shape[1]
    size_px, turn = (rng.uniform(0.04, 0.08) * w, rng.uniform(0.06, 0.12) * w), np.deg2rad(rng.uniform(0, 180))
    return plate(shape, centre_px, size_px, turn, 1 - rng.uniform(0.85, 0.95))


def plate(shape: tuple[int, int], centre_px: np.ndarray, size_px: tuple[float, float], turn: float,
          share: float) -> np.ndarray:
    """A rectangle about `centre_px` (u, v) that lets `share` through; its first side lies at `turn` rad from u towards
    v."""
    box = (tuple(float(c) for c in centre_px), tuple(float(n) for n in size_px), float(np.rad2deg(turn)))
    drawn = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(drawn, np.rint(cv2.boxPoints(box) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    return 1 - drawn * np.float32((1 - share) / 255)


def burn_in(image: np.ndarray, lines: tuple[str, ...] = ('FLUORO 15 P/S', '78 KV  4.1 MA', 'SIM')) -> np.ndarray:
    """(H, W) uint8 or uint16: the image with lines of text at its upper left border, in full white."""
    scale = image.shape[1] / 1024
    text = np.zeros(image.shape, np.uint8)
    for k, line in enumerate(lines):
        at = (round(6 * scale), round((14 + 14 * k) * scale))
        cv2.putText(text, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * scale, 255, max(1, round(scale)))
    return np.maximum(image, text.astype(image.dtype) * (np.iinfo(image.dtype).max // 255))


def _half(shape: tuple[int, int]) -> tuple[int, int]:
    """Anatomy is smooth enough to be made at half the size."""
    return (shape[0] + 1) // 2, (shape[1] + 1) // 2


def _full(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(image.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)


def _winding(rng: np.random.Generator, shape: tuple[int, int], sway: float) -> np.ndarray:
    """(200, 2) u, v: a smooth curve from one side of the field to another."""
    h, w = shape
    turn = rng.uniform(0, 2 * np.pi)
    along = np.linspace(-0.75, 0.75, 6)
    across = np.cumsum(rng.normal(0, sway, 6)) + rng.uniform(-0.3, 0.3)
    direction, normal = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    knots = (along[:, None] * direction + (across - across.mean())[:, None] * normal
             + rng.normal(0, 0.15) * normal) * max(h, w)
    return CubicSpline(along, knots)(np.linspace(-0.75, 0.75, 200)) + [w / 2, h / 2]


def _tube_depth(curve: np.ndarray, outer: float, inner: float, shape: tuple[int, int]) -> np.ndarray:
    """(H/2, W/2) px: path length across a tube (hollow for inner > 0) about an (N, 2) u, v curve of the full-size
    image."""
    off = np.full(_half(shape), 255, np.uint8)
    cv2.polylines(off, [np.rint(curve * 8).astype(np.int32)], False, 0, 1, cv2.LINE_8, 4)
    # no curve in sight: far away
    d2 = (2 * np.minimum(cv2.distanceTransform(off, cv2.DIST_L2, 5), np.float32(outer)))**2
    depth = 2 * (np.sqrt(np.maximum(outer**2 - d2, 0)) - np.sqrt(np.maximum(inner**2 - d2, 0)))
    return cv2.GaussianBlur(depth, (0, 0), 1.0)


def _opening(window: np.ndarray, softness_px: float) -> np.ndarray:
    """The beam through an opening (255 where open), with a soft edge and a little scatter behind the metal."""
    soft = cv2.GaussianBlur(window, (0, 0), max(softness_px, 0.5))
    return 0.02 + soft * np.float32(0.98 / 255)
