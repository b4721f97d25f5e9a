"""A drawn biplane pair with known answer, without ROS: what the tests of the offline tools stand on."""

import cv2
import numpy as np

from fluoro_shape_ros.geometry.cameras import make_view
from fluoro_shape_ros.sim import xray
from msg_adapters.calibration import Calibration

SIZE = 320                          # px, both ways
K = np.array([[800.0, 0, (SIZE - 1) / 2], [0, 800.0, (SIZE - 1) / 2], [0, 0, 1]])
RADIUS = 1e-3                       # m, of the wire
TOLERANCE = 0.0025                  # m: a pixel is 1 mm


def curve():
    """(600, 3) m, base to tip: 10 cm long, bent in space."""
    s = np.linspace(0, 1, 600)
    return np.c_[0.03 * np.sin(2.2 * s) - 0.01, 0.025 * (1 - np.cos(1.7 * s)) - 0.01, 0.09 * s - 0.045]


def projection(angle):
    """(3, 4) P of a source 0.8 m from the origin that looks at it horizontally; 1 px is 1 mm there."""
    forward = np.array([np.sin(angle), np.cos(angle), 0.0])
    right = np.cross(forward, [0, 0, 1.0])
    return K @ np.c_[np.stack([right, np.cross(forward, right), forward]), [0, 0, 0.8]]


def draw(P, size=SIZE, device=True, points=curve()):    # noqa: B008 (never changed)
    """(size, size) uint8: the shadow of a round wire along (N, 3) points, blurred, on a bright, even background."""
    wire = (xray.transmission(points, RADIUS, make_view('a', P, size, size), xray.Exposure(contrast=0.7))
            if device else np.ones((size, size), np.float32))
    return np.rint(cv2.GaussianBlur(180 * wire, (5, 5), 0)).astype(np.uint8)


VIEWS = [projection(0), projection(np.pi / 2)]
GOOD, BLANK = ([draw(P, device=device) for P in VIEWS] for device in (True, False))
CALIBRATIONS = [Calibration(f'plane_{p}', SIZE, SIZE, K, P, 'plumb_bob', np.zeros(5)) for p, P in zip('ab', VIEWS)]
BASE = 'base_position=[{:.4f},{:.4f},{:.4f}]'.format(*curve()[0])      # so that the tip is no guess
