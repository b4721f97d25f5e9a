"""X-ray angiography runs (DICOM XA and Enhanced XA) as images, cameras and times. Needs pydicom (extra `dicom`).

The header is in dicom_header, where the frames are in dicom_frames, their pixels in dicom_pixels, the cameras in
dicom_geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.calibration import Calibration

from .dicom_frames import count_frames
from .dicom_geometry import calibrations, headers_of_frames
from .dicom_header import BadDicom, check_pixels, number, numbers, read_header, reading, words

MAX_FRAMES = 100_000        # no angiograph makes more
# of ImageType, and of PlaneIdentification (Enhanced XA)
PLANES = {'BIPLANE A': 'a', 'BIPLANE B': 'b', 'PLANE A': 'a', 'PLANE B': 'b'}


@dataclass(frozen=True)
class XaRun:
    """A run of one plane: everything but its pixels."""

    path: Path
    plane: str                      # 'a' or 'b' as the file says, or ''
    count: int                      # of its frames
    times_ns: np.ndarray | None     # (N,) of the frames from the first one on; None: the file does not say
    calibrations: list[Calibration]     # of the frames, the same object where nothing moved;
                                        # empty where they were not asked for
    header: Any                     # pydicom's dataset of KEYWORDS
    notes: tuple[str, ...] = ()     # what a person should know, a line each


def read_run(path, spacing_mm: float | None = None, *, cameras: bool = True, times: bool = True) -> XaRun:
    """The header of a multi-frame XA or Enhanced XA file, checked; what says of its cameras and times may be missing or
    wrong where nobody asks for these.

    `spacing_mm`, of the detector's pixels, wins over what the file says. Raises BadDicom, OSError and ImportError
    (without pydicom).
    """
    path = Path(path)
    header = read_header(path)
    count, notes = int(number(path, header, 'NumberOfFrames', 1, MAX_FRAMES, 1)), []
    check_pixels(path, header, count)
    there = count_frames(path, header)
    if there < count:
        raise BadDicom(f'{path}: truncated: NumberOfFrames is {count}, '
                       f'of which {there} {"is" if there == 1 else "are"} there')
    if there > count:
        notes.append(f'{path}: NumberOfFrames is {count}, but {there} are there: '
                     f'the last {there - count} {"is" if there == count + 1 else "are"} left out')
    known, note = calibrations(path, header, count, spacing_mm) if cameras else ([], '')
    plane = next((PLANES[w] for w in (*words(header, 'PlaneIdentification')[:1], *words(header, 'ImageType')[2:3])
                  if w in PLANES), '')
    return XaRun(path, plane, count, frame_times(path, header, count) if times else None, known, header,
                 tuple(filter(None, (*notes, note))))


def in_order(runs: list[XaRun]) -> list[XaRun]:
    """Two runs as plane A, plane B: as the files say, else as given. Raises BadDicom where both are of the same
    plane."""
    first, second = (run.plane for run in runs)
    if first and first == second:
        raise BadDicom(f'{runs[0].path} and {runs[1].path}: both are of plane {first.upper()}')
    return runs[::-1] if first == 'b' or second == 'a' else runs


def frame_times(path: Path, header, count: int) -> np.ndarray | None:
    """(N,) ns from the first frame on, as FrameIncrementPointer says or whatever else tells; None where nothing does.
    Raises BadDicom."""
    vector, step = numbers(path, header, 'FrameTimeVector'), numbers(path, header, 'FrameTime')
    if vector and step and header.get('FrameIncrementPointer') == 0x00181063:
        vector = []
    if vector:
        if len(vector) != count or min(vector[1:], default=1.0) <= 0:
            raise BadDicom(f'{path}: FrameTimeVector has {len(vector)} steps for {count} frames, '
                           'or some that are not positive; --rate does without it')
        return np.round(np.cumsum([0.0, *vector[1:]]) * 1e6).astype(np.int64)
    for times in _dated(path, header, count):
        return times
    for milliseconds in (step, *([1e3 / r for r in numbers(path, header, k) if r > 0]
                                 for k in ('CineRate', 'RecommendedDisplayFrameRate'))):
        if milliseconds and 0 < milliseconds[0] < 1e7:
            return np.round(np.arange(count) * milliseconds[0] * 1e6).astype(np.int64)
    return None if count > 1 else np.zeros(1, np.int64)


def _dated(path: Path, header, count: int) -> list[np.ndarray]:
    """The times that Enhanced XA has frame by frame, in ns from the first one on, of each kind that every frame has and
    that goes on."""
    from pydicom.valuerep import DT

    frames, found = headers_of_frames(path, header, count), []
    for keyword in ('FrameAcquisitionDateTime', 'FrameReferenceDateTime'):
        if count > 1 and all(keyword in frame for frame in frames):
            with reading(path, keyword):
                dates = [DT(str(frame[keyword])) for frame in frames]
                # OverflowError: centuries apart
                times = np.array([round((date - dates[0]).total_seconds() * 1e6) * 1000 for date in dates], np.int64)
            if all(early < late for early, late in pairwise(times)):
                found.append(times)
    return found
