"""X-ray angiography runs (DICOM XA) as images, cameras and times. Needs pydicom (extra `dicom`).

What is read of a file are the attributes in KEYWORDS and the pixels: nothing that tells whose images they are, and no dates.

Geometry (PS3.3 C.8.7.5, PS3.17 FFF.2.1): the reference frame has its origin at the isocentre and the axes of the patient: x to the left, y
to the back, z to the head, m. The isocentre projects into the middle of the image, and the image is shown as usual, the patient facing the
viewer: at angles 0, 0 u runs to the patient's left and v to the feet, so it is the mirror image of what the source sees. PatientOrientation, where
there is one, decides against that. A moving table is not regarded.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msg_adapters.calibration import Calibration

from ..sim.carm import camera_from_patient

ENHANCED_XA = '1.2.840.10008.5.1.4.1.1.12.1.1'
DEFLATED = '1.2.840.10008.1.2.1.99'
MAX_SIDE, MAX_FRAMES = 8192, 100_000        # px; no angiograph makes more
MAX_RATIO = 1000            # of a run to its file; no compression of X-ray images with noise comes near
KEYWORDS = ('SOPClassUID', 'ImageType', 'Rows', 'Columns', 'NumberOfFrames', 'SamplesPerPixel', 'PhotometricInterpretation', 'BitsAllocated', 'BitsStored',
            'HighBit', 'PixelRepresentation', 'PixelIntensityRelationship', 'ModalityLUTSequence', 'DistanceSourceToDetector', 'DistanceSourceToPatient',
            'ImagerPixelSpacing', 'PositionerPrimaryAngle', 'PositionerSecondaryAngle', 'PositionerPrimaryAngleIncrement',
            'PositionerSecondaryAngleIncrement', 'PatientOrientation', 'FrameIncrementPointer', 'FrameTime', 'FrameTimeVector', 'CineRate',
            'RecommendedDisplayFrameRate', 'ExtendedOffsetTable', 'ExtendedOffsetTableLengths')
TOWARDS = {'L': (1, 0, 0), 'R': (-1, 0, 0), 'P': (0, 1, 0), 'A': (0, -1, 0), 'H': (0, 0, 1), 'F': (0, 0, -1)}   # letters of PatientOrientation


class BadDicom(ValueError):
    """A file that is no XA run that can be used; the message names it and tells why, without what else is in the file."""


def one_line(text: str) -> str:
    """The begin of what comes from a file, as it may be shown: control characters would command a terminal."""
    return ''.join(c if c.isprintable() else '?' for c in ' '.join(text.split())[:200])


@dataclass(frozen=True)
class XaRun:
    """A run of one plane: everything but its pixels."""

    path: Path
    plane: str                      # 'a' or 'b' as the file says, or ''
    times_ns: np.ndarray | None     # (N,) of the frames from the first one on; None: the file does not say
    calibrations: list[Calibration]     # of the frames; the same object where nothing moved
    header: object                  # pydicom's dataset of KEYWORDS


def read_run(path) -> XaRun:
    """The header of a multi-frame XA file, checked. Raises BadDicom, OSError and ImportError (without pydicom)."""
    path = Path(path)
    header = _header(path)
    count = int(_number(path, header, 'NumberOfFrames', 1, MAX_FRAMES, 1))
    _check_pixels(path, header, count)
    plane = {'BIPLANE A': 'a', 'BIPLANE B': 'b'}.get((*_words(header, 'ImageType'), '', '', '')[2], '')
    return XaRun(path, plane, frame_times(path, header, count), calibrations(path, header, count), header)


def in_order(runs: list[XaRun]) -> list[XaRun]:
    """Two runs as plane A, plane B: as the files say, else as given. Raises BadDicom where both are of the same plane."""
    first, second = (run.plane for run in runs)
    if first and first == second:
        raise BadDicom(f'{runs[0].path} and {runs[1].path}: both are of plane {first.upper()}')
    return runs[::-1] if first == 'b' or second == 'a' else runs


# ---- header


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Makes whatever pydicom raises on a damaged file a BadDicom; nothing of ours belongs into the block, whose errors would be taken for the file's."""
    try:
        yield
    except Exception as error:      # on a damaged file pydicom raises anything
        raise BadDicom(f'{path}: damaged: {what} can\'t be read ({type(error).__name__})') from error


def _header(path: Path):
    """pydicom's dataset of KEYWORDS. Raises BadDicom."""
    import pydicom
    from pydicom.filereader import read_file_meta_info
    from pydicom.tag import Tag

    # what pydicom says of odd values quotes them
    logging.getLogger('pydicom').setLevel(logging.CRITICAL)
    warnings.filterwarnings('ignore', module='pydicom')
    with path.open('rb') as file:
        if file.read(132)[128:] != b'DICM':
            raise BadDicom(f'{path}: not a DICOM file')
    with reading(path, 'its header'):
        syntax = read_file_meta_info(path).TransferSyntaxUID
    if syntax == DEFLATED:      # would be inflated as a whole, to whatever size
        raise BadDicom(f'{path}: deflated as a whole; save it uncompressed first')
    if syntax not in pydicom.uid.AllTransferSyntaxes:
        raise BadDicom(f'{path}: written in a transfer syntax that is not known')
    tags = [Tag(keyword) for keyword in KEYWORDS]
    with reading(path, 'its header'):
        header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=tags)
    for keyword in KEYWORDS:
        with reading(path, keyword):
            value = header.get(keyword)     # pydicom looks at a value when it is first asked for
        if isinstance(value, pydicom.Sequence) and keyword != 'ModalityLUTSequence':    # whose own values it has not looked at yet
            raise BadDicom(f'{path}: damaged: {keyword} is a sequence')
    if str(header.get('SOPClassUID', '')) == ENHANCED_XA:
        raise BadDicom(f'{path}: an Enhanced XA image; only XA images are read')
    return header


def _number(path: Path, header, keyword: str, low: float, high: float, default: float | None = None) -> float:
    values = _numbers(path, header, keyword)
    if not values:
        if default is None:
            raise BadDicom(f'{path}: {keyword} is missing')
        return default
    if len(values) > 1 or not low <= values[0] <= high:
        raise BadDicom(f'{path}: {keyword} must be one number in [{low:g}, {high:g}]')
    return values[0]


def _numbers(path: Path, header, keyword: str) -> list[float]:
    """The values of an attribute; none where it is missing or empty."""
    try:
        value = header.get(keyword)
        values = [] if value is None or value == '' else [float(v) for v in np.atleast_1d(value)]
    except (TypeError, ValueError, OverflowError, AttributeError):
        raise BadDicom(f'{path}: {keyword} is not a number') from None
    if not np.isfinite(values).all():
        raise BadDicom(f'{path}: {keyword} is not finite')
    return values


def _words(header, keyword: str) -> list[str]:
    """The values of an attribute as texts; none where it is missing."""
    value = header.get(keyword)
    return [] if value is None else [str(v).strip() for v in np.atleast_1d(np.array(value, object))]


def _check_pixels(path: Path, header, count: int) -> None:
    """Raises BadDicom for pixels that can't be read, before any memory is taken for them."""
    from pydicom.pixels import get_decoder

    rows, columns = (int(_number(path, header, k, 1, MAX_SIDE)) for k in ('Rows', 'Columns'))
    allocated, kind = int(_number(path, header, 'BitsAllocated', 1, 64)), str(header.get('PhotometricInterpretation', ''))
    stored = int(_number(path, header, 'BitsStored', 1, allocated, allocated))
    high = int(_number(path, header, 'HighBit', stored - 1, allocated - 1, stored - 1))
    if allocated not in (8, 16) or _number(path, header, 'SamplesPerPixel', 1, 4, 1) != 1 or kind not in ('MONOCHROME1', 'MONOCHROME2'):
        raise BadDicom(f'{path}: only grey pixels of 8 or 16 bits are read, not {one_line(kind)[:16] or "unknown ones"} of {allocated} ({stored} stored, the highest is {high})')
    syntax, size, needed = header.file_meta.TransferSyntaxUID, path.stat().st_size, rows * columns * count * allocated // 8
    if not syntax.is_encapsulated:
        if needed > size:
            raise BadDicom(f'{path}: truncated: {count} frames of {columns}x{rows} px need {needed} bytes, the file has {size}')
        return
    try:
        decoder = get_decoder(syntax)
    except NotImplementedError:
        raise BadDicom(f'{path}: compressed as {syntax.name}, which can\'t be decoded') from None
    if not decoder.is_available:
        missing = '; '.join(decoder.missing_dependencies)
        raise BadDicom(f'{path}: compressed as {syntax.name}, which can\'t be decoded here: it needs one of {missing}')
    if 8 * count > size:
        raise BadDicom(f'{path}: truncated: {count} compressed frames in {size} bytes')
    if needed > MAX_RATIO * size:
        raise BadDicom(f'{path}: {count} frames of {columns}x{rows} px are more than {MAX_RATIO} times as large as the file')


# ---- time and geometry


def frame_times(path: Path, header, count: int) -> np.ndarray | None:
    """(N,) ns from the first frame on, as FrameIncrementPointer says or whatever else tells; None where nothing does. Raises BadDicom."""
    vector, step = _numbers(path, header, 'FrameTimeVector'), _numbers(path, header, 'FrameTime')
    if vector and step and header.get('FrameIncrementPointer') == 0x00181063:
        vector = []
    if vector:
        if len(vector) != count or min(vector[1:], default=1.0) <= 0:
            raise BadDicom(f'{path}: FrameTimeVector has {len(vector)} steps for {count} frames, or some that are not positive')
        return np.round(np.cumsum([0.0, *vector[1:]]) * 1e6).astype(np.int64)
    for milliseconds in (step, *([1e3 / r for r in _numbers(path, header, k) if r > 0] for k in ('CineRate', 'RecommendedDisplayFrameRate'))):
        if milliseconds and 0 < milliseconds[0] < 1e7:
            return np.round(np.arange(count) * milliseconds[0] * 1e6).astype(np.int64)
    return None if count > 1 else np.zeros(1, np.int64)


def calibrations(path: Path, header, count: int) -> list[Calibration]:
    """The camera of each frame; the angles are those of the first frame plus the increments relative to it. Raises BadDicom."""
    sid, sod = (_number(path, header, k, 1.0, 1e4) / 1e3 for k in ('DistanceSourceToDetector', 'DistanceSourceToPatient'))
    if not sod < sid:
        raise BadDicom(f'{path}: the isocentre ({sod * 1e3:g} mm from the source) is not in front of the detector ({sid * 1e3:g} mm)')
    spacing = _numbers(path, header, 'ImagerPixelSpacing')
    if len(spacing) != 2 or not 1e-3 < min(spacing) <= max(spacing) < 10:
        raise BadDicom(f'{path}: ImagerPixelSpacing must be two distances in mm')
    angles = np.stack([_angles(path, header, which, count) for which in ('Primary', 'Secondary')], axis=1)
    known = {}
    for pair in map(tuple, angles.tolist()):
        if pair not in known:
            known[pair] = _calibration(path, header, np.deg2rad(pair), sid, sod, spacing)
    return [known[pair] for pair in map(tuple, angles.tolist())]


def _angles(path: Path, header, which: str, count: int) -> np.ndarray:
    first = _number(path, header, f'Positioner{which}Angle', -360, 360)
    steps = _numbers(path, header, f'Positioner{which}AngleIncrement') or [0.0]
    if len(steps) not in (1, count):
        raise BadDicom(f'{path}: Positioner{which}AngleIncrement has {len(steps)} values for {count} frames')
    return first + np.broadcast_to(steps, count)


def _calibration(path: Path, header, angles: np.ndarray, sid: float, sod: float, spacing: list[float]) -> Calibration:
    """The camera at two angles in rad."""
    width, height = int(header.Columns), int(header.Rows)
    R = camera_from_patient(*angles)
    signs = [-1.0, 1.0]         # u and v of the image against those that the source sees
    for k, letter in enumerate(word[:1] for word in _words(header, 'PatientOrientation')[:2]):
        signs[k] *= -1.0 if letter in TOWARDS and signs[k] * R[k] @ TOWARDS[letter] < 0 else 1.0
    K = np.array([[signs[0] * sid / spacing[1] * 1e3, 0.0, (width - 1) / 2], [0.0, signs[1] * sid / spacing[0] * 1e3, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Calibration('', width, height, K, K @ np.c_[R, [0.0, 0.0, sod]], 'plumb_bob', np.zeros(5))
