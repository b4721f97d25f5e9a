"""The cameras of a DICOM XA run, frame by frame.

Geometry (PS3.3 C.8.7.5, PS3.17 FFF.2.1): the reference frame has its origin at the isocentre and the axes of the
patient: x to the left, y to the back, z to the head, m. The isocentre projects into the middle of the image, and the
image is shown as usual, the patient facing the viewer: at angles 0, 0 u runs to the patient's left and v to the feet,
so it is the mirror image of what the source sees. PatientOrientation, where there is one, decides against that. A
moving table is not regarded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from msg_adapters.calibration import Calibration

from ..sim.carm import camera_from_patient
from .dicom_header import BadDicom, number, numbers, reading, words

# letters of PatientOrientation
TOWARDS = {'L': (1, 0, 0), 'R': (-1, 0, 0), 'P': (0, 1, 0), 'A': (0, -1, 0), 'H': (0, 0, 1), 'F': (0, 0, -1)}
SQUARE = 0.02       # pixels whose sides differ by less may be square, and their sides have been rounded
# what Enhanced XA says frame by frame: keyword -> sequence of a functional group (PS3.3 C.7.6.16,
# C.8.19.6) and keyword in it
GROUPS = {
    'DistanceSourceToPatient': ('XRayGeometrySequence', 'DistanceSourceToIsocenter'),
    'DistanceSourceToDetector': ('XRayGeometrySequence', 'DistanceSourceToDetector'),
    'PositionerPrimaryAngle': ('PositionerPositionSequence', 'PositionerPrimaryAngle'),
    'PositionerSecondaryAngle': ('PositionerPositionSequence', 'PositionerSecondaryAngle'),
    'ImagerPixelSpacing': ('FramePixelDataPropertiesSequence', 'ImagerPixelSpacing'),
    'PixelIntensityRelationship': ('FramePixelDataPropertiesSequence', 'PixelIntensityRelationship'),
    'FieldOfViewShape': ('FieldOfViewSequence', 'FieldOfViewShape'),
    'FieldOfViewDimensions': ('FieldOfViewSequence', 'FieldOfViewDimensionsInFloat'),
    'PatientOrientation': ('PatientOrientationInFrameSequence', 'PatientOrientation'),
    'FrameAcquisitionDateTime': ('FrameContentSequence', 'FrameAcquisitionDateTime'),
    'FrameReferenceDateTime': ('FrameContentSequence', 'FrameReferenceDateTime'),
}
OF_A_CAMERA = ('DistanceSourceToDetector', 'DistanceSourceToPatient', 'EstimatedRadiographicMagnificationFactor',
               'ImagerPixelSpacing', 'PixelSpacing', 'FieldOfViewShape', 'FieldOfViewDimensions', 'PatientOrientation',
               'PositionerPrimaryAngle', 'PositionerSecondaryAngle', 'Rows', 'Columns')


def headers_of_frames(path: Path, header, count: int) -> list[dict]:
    """What may change from frame to frame by its keyword; the same object where nothing is said frame by frame. Raises
    BadDicom."""
    flat = {keyword: header.get(keyword) for keyword in (*OF_A_CAMERA, 'PixelIntensityRelationship')}
    shared, own = ([_group(path, item) for item in header.get(f'{which}FunctionalGroupsSequence') or ()]
                   for which in ('Shared', 'PerFrame'))
    if not shared and not own:
        return [flat] * count
    if len(own) < count:
        raise BadDicom(f'{path}: its functional groups are for {len(own)} frames, but there are {count}')
    common = flat | (shared[0] if shared else {})
    return [common | group for group in own[:count]]


def _group(path: Path, item) -> dict:
    """What GROUPS has of an item of functional groups."""
    found = {}
    for keyword, (sequence, name) in GROUPS.items():
        with reading(path, f'{name} of its functional groups'):
            inner = item.get(sequence)
            value = inner[0].get(name) if inner else None
        if value is not None and value != '':
            found[keyword] = value
    return found


def calibrations(path: Path, header, count: int, spacing_mm: float | None = None) -> tuple[list[Calibration], str]:
    """The camera of each frame, one object where nothing moved, and what had to be said of them in one line.

    The angles of a classic XA image are those of the first frame plus the increments relative to it. `spacing_mm`, of
    the detector's pixels, wins over what the file says. Raises BadDicom.
    """
    steps = np.stack([_increments(path, header, which, count) for which in ('Primary', 'Secondary')], axis=1)
    known, cameras, note = {}, [], ''
    for frame, step in zip(headers_of_frames(path, header, count), steps.tolist(), strict=True):
        key = (str([frame.get(keyword) for keyword in OF_A_CAMERA]), *step)
        if key not in known:
            known[key], note = _calibration(path, frame, step, spacing_mm)
        cameras.append(known[key])
    return cameras, note


def _increments(path: Path, header, which: str, count: int) -> np.ndarray:
    steps = numbers(path, header, f'Positioner{which}AngleIncrement') or [0.0]
    if len(steps) not in (1, count):
        raise BadDicom(f'{path}: Positioner{which}AngleIncrement has {len(steps)} values for {count} frames')
    return np.broadcast_to(steps, count)


def _calibration(path: Path, frame, steps: list[float], spacing_mm: float | None) -> tuple[Calibration, str]:
    """The camera of a frame whose angles have gone on by `steps` degrees, and what is to be said of it."""
    sid, sod = _distances(path, frame)
    spacing, note = ([spacing_mm] * 2, '') if spacing_mm else pixel_spacing(path, frame, sid / sod)
    angles = np.deg2rad([number(path, frame, f'Positioner{which}Angle', -360, 360)
                         for which in ('Primary', 'Secondary')]) + np.deg2rad(steps)
    width, height = int(frame['Columns']), int(frame['Rows'])
    R = camera_from_patient(*angles)
    signs = [-1.0, 1.0]         # u and v of the image against those that the source sees
    for k, letter in enumerate(word[:1] for word in words(frame, 'PatientOrientation')[:2]):
        signs[k] *= -1.0 if letter in TOWARDS and signs[k] * R[k] @ TOWARDS[letter] < 0 else 1.0
    K = np.array([[signs[0] * sid / spacing[1] * 1e3, 0.0, (width - 1) / 2],
                  [0.0, signs[1] * sid / spacing[0] * 1e3, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Calibration('', width, height, K, K @ np.c_[R, [0.0, 0.0, sod]], 'plumb_bob', np.zeros(5)), note


def _distances(path: Path, frame) -> tuple[float, float]:
    """From the source to detector and isocentre, m."""
    sid = number(path, frame, 'DistanceSourceToDetector', 1.0, 1e4) / 1e3
    factor = number(path, frame, 'EstimatedRadiographicMagnificationFactor', 1.0, 100.0, 0.0)
    sod = number(path, frame, 'DistanceSourceToPatient', 1.0, 1e4, sid * 1e3 / factor if factor else None) / 1e3
    if not sod < sid:
        raise BadDicom(f'{path}: the isocentre ({sod * 1e3:g} mm from the source) is not in front of the detector '
                       f'({sid * 1e3:g} mm)')
    return sid, sod


def pixel_spacing(path: Path, frame, magnification: float) -> tuple[list[float], str]:
    """Distances of the detector's rows and columns, mm, and a line where they are not said outright. Raises
    BadDicom."""
    spacing = numbers(path, frame, 'ImagerPixelSpacing')
    note = ''
    if not spacing and (field := numbers(path, frame, 'FieldOfViewDimensions')):
        spacing = _of_the_field(field, int(frame['Rows']), int(frame['Columns']))
        note = (f'{path}: no ImagerPixelSpacing; {{}} mm is what the field of view of '
                f'{" x ".join(f"{f:g}" for f in field)} mm gives')
    if not spacing and (there := numbers(path, frame, 'PixelSpacing')):
        factor = number(path, frame, 'EstimatedRadiographicMagnificationFactor', 1.0, 100.0, magnification)
        spacing, note = ([s * factor for s in there],
                         f'{path}: no ImagerPixelSpacing; {{}} mm is PixelSpacing magnified {factor:.3g} times')
    if not spacing:
        raise BadDicom(f'{path}: ImagerPixelSpacing must be two distances in mm, and nothing else tells them; '
                       '--pixel-spacing does')
    if len(spacing) != 2 or not 1e-3 < min(spacing) <= max(spacing) < 10:
        raise BadDicom(f'{path}: ImagerPixelSpacing must be two distances in mm')
    return spacing, note.format(f'{spacing[0]:.6g}')


def _of_the_field(field: list[float], rows: int, columns: int) -> list[float]:
    """Distances of rows and columns in a field of one or two lengths; none where its pixels would not be square, so
    that something else is meant."""
    # which of the two is the height is told by the pixels: files disagree about what "row dimension" means
    candidates = ([[field[0] / rows, field[-1] / columns], [field[-1] / rows, field[0] / columns]]
                  if len(field) <= 2 else [])
    return next((c for c in candidates if abs(c[0] - c[1]) < SQUARE * max(c)), [])
