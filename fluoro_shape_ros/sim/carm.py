"""C-arm geometry: the calibrated views of a biplane system from its angles and distances.

Reference frame: origin at the isocentre, x to the patient's left, y to the back (posterior), z to the head (DICOM LPS). The detector
stands at primary angle 0, secondary 0 in front of the patient; a positive primary angle turns it to the left (LAO), a positive
secondary one to the head (cranial), as DICOM's Positioner Primary and Secondary Angle do. Images are seen from the source: u to the
patient's right at 0, 0; v to the feet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import View
from ..geometry import make_view


@dataclass(frozen=True)
class CArm:
    """Distances and detector of one plane."""

    sid: float = 1.195                  # m, source to detector
    sod: float = 0.810                  # m, source to isocentre
    pixel_size_iso: float = 0.3e-3      # m a pixel at the isocentre; at the detector: times sid / sod
    width: int = 1024                   # px
    height: int = 1024                  # px

    @property
    def pixel_size(self) -> float:
        """Pixel size at the detector, m."""
        return self.pixel_size_iso * self.sid / self.sod


def view(name: str, primary: float, secondary: float = 0.0, arm: CArm = CArm()) -> View:
    """The view of plane `name` at two C-arm angles (rad); the principal point is the image centre."""
    beam = np.array([np.sin(primary) * np.cos(secondary), -np.cos(primary) * np.cos(secondary), np.sin(secondary)])
    right = np.array([-np.cos(primary), -np.sin(primary), 0.0])
    R = np.stack([right, np.cross(beam, right), beam])
    f = arm.sid / arm.pixel_size
    K = np.array([[f, 0.0, (arm.width - 1) / 2], [0.0, f, (arm.height - 1) / 2], [0.0, 0.0, 1.0]])
    return make_view(name, K @ np.c_[R, [0.0, 0.0, arm.sod]], arm.width, arm.height)


def biplane(angle_a: tuple[float, float] = (0.0, 0.0), angle_b: tuple[float, float] = (np.pi / 2, 0.0), arm: CArm = CArm()) -> tuple[View, View]:
    """Views of planes A and B at (primary, secondary) angles in rad."""
    return view('a', *angle_a, arm), view('b', *angle_b, arm)
