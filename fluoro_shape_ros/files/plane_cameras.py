"""The calibrations of both planes of an import: from files, under their right names, in metres."""

from __future__ import annotations

from msg_adapters.calibration import Calibration
from msg_adapters.calibration_files import in_metres, read_cameras

from ..config import Config
from ..data import View
from ..geometry.cameras import isocenter, pixels_per_metre

THIN, THICK = 0.1, 0.25     # px, and of an image's shorter side: no device is so thin or so thick in an X-ray image


def read_planes(paths: list[list[str]], unit: str = '') -> tuple[list[Calibration], list[str]]:
    """The calibrations of planes A and B from one or several files each, and what is to be said of them, a line each;
    see calibration_files.

    Of a file with several cameras plane A gets the first and plane B the second. `unit` wins over what the files say.
    Raises BadCalibration.
    """
    cameras = [read_cameras(*given) for given in paths]
    known, note = in_metres([found[min(k, len(found) - 1)] for k, found in enumerate(cameras)], unit)
    return known, [note] if note else []


def scale_notes(views: tuple[View, View]) -> list[str]:
    """A line where a device of the default radius would be seen much too thin or too thick where the planes look:
    lengths in another unit than m do that."""
    radius, center = Config().detection.robot_radius, isocenter(views)[None]
    for v in views:
        width_px = 2 * radius * pixels_per_metre(v.P, center)
        if not THIN <= width_px <= THICK * min(v.width, v.height):
            return [f'plane {v.name.upper()}: a device {2e3 * radius:g} mm thick would be {width_px:.3g} px wide where '
                    'the planes look: are the calibrations in metres?']
    return []
