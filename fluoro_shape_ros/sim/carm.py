"""C-arm geometry: the calibrated views of a biplane system from its angles and distances.

Reference frame: origin at the isocentre, x to the patient's left, y to the back (posterior), z to the head (DICOM LPS).
The detector stands at primary angle 0, secondary 0 in front of the patient; a positive primary angle turns it to the
left (LAO), a positive secondary one to the head (cranial), as DICOM's Positioner Primary and Secondary Angle do. Images
are seen from the source: u to the patient's right at 0, 0; v to the feet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import View
from ..geometry.cameras import decompose, depth, make_view, project


@dataclass(frozen=True)
class CArm:
    """Distances and detector of one plane."""

    sid: float = 1.195                  # m, source to detector
    sod: float = 0.810                  # m, source to isocentre
    pixel_size_iso: float = 0.3e-3      # m a pixel at the isocentre; at the detector: times sid / sod
    width: int = 1024                   # px
    height: int = 1024                  # px

    def __post_init__(self):
        if not 0 < self.sod < self.sid:
            raise ValueError('no C-arm: the isocentre must lie between source and detector, '
                             f'but sod is {self.sod:g} m and sid {self.sid:g} m')
        if not self.pixel_size_iso > 0 or min(self.width, self.height) < 1:
            raise ValueError(f'no detector: {self.width}x{self.height} px of {self.pixel_size_iso:g} m')

    @property
    def pixel_size(self) -> float:
        """Pixel size at the detector, m."""
        return self.pixel_size_iso * self.sid / self.sod


def camera_from_patient(primary: float, secondary: float) -> np.ndarray:
    """(3, 3) rotation of the reference frame into the camera's at two C-arm angles (rad); its rows are u and v as seen
    from the source, and the beam."""
    beam = np.array([np.sin(primary) * np.cos(secondary), -np.cos(primary) * np.cos(secondary), np.sin(secondary)])
    right = np.array([-np.cos(primary), -np.sin(primary), 0.0])
    return np.stack([right, np.cross(beam, right), beam])


def view(name: str, primary: float, secondary: float = 0.0, arm: CArm = CArm()) -> View:
    """The view of plane `name` at two C-arm angles (rad); the principal point is the image centre."""
    R = camera_from_patient(primary, secondary)
    f = arm.sid / arm.pixel_size
    K = np.array([[f, 0.0, (arm.width - 1) / 2], [0.0, f, (arm.height - 1) / 2], [0.0, 0.0, 1.0]])
    return make_view(name, K @ np.c_[R, [0.0, 0.0, arm.sod]], arm.width, arm.height)


def biplane(angle_a: tuple[float, float] = (0.0, 0.0), angle_b: tuple[float, float] = (np.pi / 2, 0.0),
            arm: CArm = CArm()) -> tuple[View, View]:
    """Views of planes A and B at (primary, secondary) angles in rad."""
    return view('a', *angle_a, arm), view('b', *angle_b, arm)


def finest_pitch(view: View, backbone: np.ndarray) -> float:
    """m a pixel, across the ray, where (N, 3) points come nearest to the source.
    Raises ValueError where they reach it."""
    nearest = depth(view.P, backbone).min()
    if nearest <= 0:
        raise ValueError(f'plane {view.name}: the device reaches the X-ray source')
    K, _, _ = decompose(view.P)
    return float(nearest / max(abs(K[0, 0]), abs(K[1, 1])))


def shadow_box(view: View, backbone: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray] | None:
    """First and past-the-last pixel (u, v) of the rectangle that holds the shadow of a tube of `radius` m; None where
    the image misses it."""
    uv = project(view.P, backbone)
    reach = radius / finest_pitch(view, backbone) + 2
    low = np.maximum(np.floor(uv.min(axis=0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(uv.max(axis=0) + reach) + 1, [view.width, view.height]).astype(int)
    return None if (low >= high).any() else (low, high)
