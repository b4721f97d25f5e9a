"""Draws docs/devices.jpg: every device preset in both planes, before drawn anatomy. `python docs/draw_devices.py`,
where the package is installed."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from fluoro_shape_ros.device import load_device, presets
from fluoro_shape_ros.overlay import stretched
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

SEED, SIZE, SHOWN = 104, 512, 256
ARM = CArm(pixel_size_iso=0.16e-3, width=SIZE, height=SIZE)
TITLE_PX = 24


def planes_of(name: str, seed: int = SEED) -> np.ndarray:
    """(TITLE_PX + 2 SHOWN, SHOWN) uint8: the preset `name` as plane A and plane B show it."""
    scene = xray_run(seed, views=biplane(arm=ARM), lengths=(0.055, 0.06), entering=True,
                     device=load_device(name)).scene()
    title = np.full((TITLE_PX, SHOWN), 255, np.uint8)
    cv2.putText(title, name, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA)
    shown = [cv2.resize(stretched(image), (SHOWN, SHOWN), interpolation=cv2.INTER_AREA) for image in scene.frame.images]
    return np.vstack([title, *shown])


def sheet() -> np.ndarray:
    """(H, W) uint8: all presets, four in a row."""
    columns = [planes_of(name) for name in presets()]
    return np.vstack([np.hstack(columns[k:k + 4]) for k in range(0, len(columns), 4)])


if __name__ == '__main__':
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name('devices.jpg')
    cv2.imwrite(str(out), sheet(), [cv2.IMWRITE_JPEG_QUALITY, 80])
