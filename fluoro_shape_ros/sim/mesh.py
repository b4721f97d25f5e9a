"""A device as closed triangle meshes, for renderers that draw surfaces.

Each piece of a device is one closed surface: a tube about the backbone with flat ends, whose triangles run
anticlockwise as seen from outside the material. Where it has a lumen, an inner wall is turned inside out and rings
close the ends.
"""

from __future__ import annotations

import numpy as np

from ..device import Device
from ..geometry.curve import arc_length, frames

SIDES = 64      # of a tube; its cross-section has the circle's area, its width is off by at most 0.08 %
SAG = 5e-7      # m: how far the chords of a bend may lie inside it
LONGEST = 1e-3  # m, of a triangle; some renderers interpolate distance from the source between vertices, which is off
                # by length^2 / (8 distance)


def device_meshes(backbone: np.ndarray, device: Device) -> dict[str | float, tuple[np.ndarray, np.ndarray]]:
    """(V, 3) vertices in m and (T, 3) triangles of all that is of one material, for each in a device about the (N, 3)
    backbone, base to tip."""
    s = arc_length(backbone)
    axis = np.concatenate([backbone, *frames(backbone)], axis=1)
    bend = np.linalg.norm(np.gradient(axis[:, 3:6], s, axis=0), axis=1).max()
    step = min(np.sqrt(8 * SAG / max(bend, 1e-9)), LONGEST)
    surfaces: dict[str | float, list] = {}
    for p in device.pieces(s[-1]):
        start, stop = max(0.0, s[-1] - p.stop), s[-1] - p.start
        at = np.linspace(start, stop, 1 + int(np.ceil((stop - start) / step)))
        surfaces.setdefault(p.material, []).append(tube(axis, at, p.radius, p.lumen))
    return {material: together(parts) for material, parts in surfaces.items()}


def tube(axis: np.ndarray, at: np.ndarray, radius: float, lumen: float) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) vertices in m and (T, 3) triangles of a tube of `radius` m, hollow where `lumen` (m, radius) is not 0,
    through (M,) arc lengths in m.

    `axis` is (N, 9): points of the backbone, tangents and normals.
    """
    s = arc_length(axis[:, :3])
    centres, tangents, normals = np.stack([np.interp(at, s, c) for c in axis.T],
                                          axis=1).reshape(-1, 3, 3).swapaxes(0, 1)
    sideways = np.cross(tangents, normals)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    upwards = np.cross(sideways, tangents)
    upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
    turn = 2 * np.pi / SIDES * np.arange(SIDES)
    # a polygon of the circle's area
    ring = np.sqrt(turn[1] / np.sin(turn[1])) * (np.cos(turn)[:, None] * upwards[:, None]
                                                 + np.sin(turn)[:, None] * sideways[:, None])
    outer, inner = ((centres[:, None] + r * ring).reshape(-1, 3) for r in (radius, lumen))
    n, wall = len(outer), _wall(len(at))
    j, k = _around()
    if lumen:
        cap = np.concatenate([np.stack([n + j, j, k], axis=1), np.stack([n + j, k, n + k], axis=1)])    # faces the tip
        return np.concatenate([outer, inner]), np.concatenate([wall, n + wall[:, ::-1], cap[:, ::-1], n - SIDES + cap])
    first, last = (np.full(SIDES, n + end) for end in (0, 1))
    caps = np.stack([first, k, j], axis=1), np.stack([last, n - SIDES + j, n - SIDES + k], axis=1)
    return np.concatenate([outer, centres[[0, -1]]]), np.concatenate([wall, *caps])


def box(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(8, 3) vertices and (12, 3) triangles of the box between two corners."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
             [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return low + corners * (high - low), np.array(sides)


def together(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Meshes as one: their vertices and triangles one after another."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (np.concatenate([v for v, _ in parts]),
            np.concatenate([n + triangles for n, (_, triangles) in zip(first, parts)]))


def _wall(rings: int) -> np.ndarray:
    """(T, 3) triangles between successive rings of SIDES vertices."""
    j, k = _around()
    pair = np.concatenate([np.stack([j, k, SIDES + j], axis=1), np.stack([k, SIDES + k, SIDES + j], axis=1)])
    return (SIDES * np.arange(rings - 1)[:, None, None] + pair).reshape(-1, 3)


def _around() -> tuple[np.ndarray, np.ndarray]:
    """Each of SIDES vertices and the next one."""
    j = np.arange(SIDES)
    return j, np.roll(j, -1)
