"""The header of a DICOM XA file: which attributes are read, and what may be in them. Needs pydicom (extra `dicom`).

What is read of a file are the attributes in KEYWORDS and the pixels: nothing that tells whose images they are, and no
dates but for the differences of the frames' times.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

DEFLATED = '1.2.840.10008.1.2.1.99'
MAX_SIDE = 8192             # px; no angiograph makes more
MAX_RATIO = 1000            # of a run to its file; no compression of X-ray images with noise comes near
# whose own values pydicom has not looked at yet
SEQUENCES = ('ModalityLUTSequence', 'SharedFunctionalGroupsSequence', 'PerFrameFunctionalGroupsSequence')
KEYWORDS = ('SOPClassUID', 'ImageType', 'PlaneIdentification', 'Rows', 'Columns', 'NumberOfFrames', 'SamplesPerPixel',
            'PhotometricInterpretation', 'PresentationLUTShape', 'BitsAllocated', 'BitsStored', 'HighBit',
            'PixelRepresentation', 'PixelIntensityRelationship',
            'DistanceSourceToDetector', 'DistanceSourceToPatient', 'EstimatedRadiographicMagnificationFactor',
            'ImagerPixelSpacing', 'PixelSpacing', 'FieldOfViewShape', 'FieldOfViewDimensions', 'PositionerPrimaryAngle',
            'PositionerSecondaryAngle', 'PositionerPrimaryAngleIncrement', 'PositionerSecondaryAngleIncrement',
            'PatientOrientation', 'FrameIncrementPointer', 'FrameTime', 'FrameTimeVector', 'CineRate',
            'RecommendedDisplayFrameRate', *SEQUENCES)


class BadDicom(ValueError):
    """A file that is no XA run that can be used; the message names it and tells why, without what else is in the
    file."""


def one_line(text: str) -> str:
    """The begin of what comes from a file, as it may be shown: control characters would command a terminal."""
    return ''.join(c if c.isprintable() else '?' for c in ' '.join(text.split())[:200])


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Makes whatever pydicom raises on a damaged file a BadDicom; nothing of ours belongs into the block, whose errors
    would be taken for the file's."""
    try:
        yield
    except Exception as error:      # on a damaged file pydicom raises anything
        raise BadDicom(f'{path}: damaged: {what} can\'t be read') from error


def read_header(path: Path):
    """pydicom's dataset of KEYWORDS; its file_meta has a TransferSyntaxUID. Raises BadDicom."""
    import pydicom
    from pydicom.tag import Tag

    # what pydicom says of odd values quotes them
    logging.getLogger('pydicom').setLevel(logging.CRITICAL)
    warnings.filterwarnings('ignore', module='pydicom')
    syntax = _transfer_syntax(path)
    if syntax == DEFLATED:      # would be inflated as a whole, to whatever size
        raise BadDicom(f'{path}: deflated as a whole; save it uncompressed first')
    if syntax is not None and syntax not in pydicom.uid.AllTransferSyntaxes:
        raise BadDicom(f'{path}: written in a transfer syntax that is not known')
    with reading(path, 'its header'):
        header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=[Tag(keyword) for keyword in KEYWORDS],
                                 force=True)
        if syntax is None:
            implicit, little = header.original_encoding
            syntax = (pydicom.uid.ImplicitVRLittleEndian if implicit else pydicom.uid.ExplicitVRLittleEndian if little
                      else pydicom.uid.ExplicitVRBigEndian)
        header.file_meta = pydicom.dataset.FileMetaDataset()
        header.file_meta.TransferSyntaxUID = pydicom.uid.UID(syntax)        # which a damaged file may have as a text
    for keyword in KEYWORDS:
        with reading(path, keyword):
            value = header.get(keyword)     # pydicom looks at a value when it is first asked for
        if isinstance(value, pydicom.Sequence) and keyword not in SEQUENCES:
            raise BadDicom(f'{path}: damaged: {keyword} is a sequence')
    return header


def _transfer_syntax(path: Path):
    """How a file is written; None where it does not say, because it begins with its data set (PS3.10 7.1 asks for more,
    older archives do not)."""
    from pydicom.filereader import _read_file_meta_info, read_preamble  # the public one of these wants a preamble

    with path.open('rb') as file:
        head = file.read(132)
        if head[128:] != b'DICM' and head[:2] not in (b'\x02\0', b'\x08\0'):
            raise BadDicom(f'{path}: not a DICOM file')
        file.seek(0)
        with reading(path, 'its header'):
            read_preamble(file, force=True)
            return _read_file_meta_info(file).get('TransferSyntaxUID')


def number(path: Path, header, keyword: str, low: float, high: float, default: float | None = None) -> float:
    """The one value of an attribute. Raises BadDicom where it is missing and has no default, and where it is out of
    range."""
    values = numbers(path, header, keyword)
    if not values:
        if default is None:
            raise BadDicom(f'{path}: {keyword} is missing')
        return default
    if len(values) > 1 or not low <= values[0] <= high:
        raise BadDicom(f'{path}: {keyword} must be one number in [{low:g}, {high:g}]')
    return values[0]


def numbers(path: Path, header, keyword: str) -> list[float]:
    """The values of an attribute; none where it is missing or empty. Raises BadDicom."""
    try:
        value = header.get(keyword)
        values = [] if value is None or value == '' else [float(v) for v in np.atleast_1d(value)]
    except (TypeError, ValueError, OverflowError, AttributeError):
        raise BadDicom(f'{path}: {keyword} is not a number') from None
    if not np.isfinite(values).all():
        raise BadDicom(f'{path}: {keyword} is not finite')
    return values


def words(header, keyword: str) -> list[str]:
    """The values of an attribute as texts; none where it is missing."""
    value = header.get(keyword)
    return [] if value is None else [str(v).strip() for v in np.atleast_1d(np.array(value, object))]


def check_pixels(path: Path, header, count: int) -> None:
    """Raises BadDicom for pixels that can't be read, before any memory is taken for them."""
    from pydicom.pixels import get_decoder

    rows, columns = (int(number(path, header, k, 1, MAX_SIDE)) for k in ('Rows', 'Columns'))
    allocated, kind = (int(number(path, header, 'BitsAllocated', 1, 64)),
                       str(header.get('PhotometricInterpretation', '')))
    stored = int(number(path, header, 'BitsStored', 1, allocated, allocated))
    high = int(number(path, header, 'HighBit', stored - 1, allocated - 1, stored - 1))
    if (allocated not in (8, 16) or number(path, header, 'SamplesPerPixel', 1, 4, 1) != 1
            or kind not in ('MONOCHROME1', 'MONOCHROME2')):
        raise BadDicom(f'{path}: only grey pixels of 8 or 16 bits are read, '
                       f'not {one_line(kind)[:16] or "unknown ones"} of {allocated} '
                       f'({stored} stored, the highest is {high})')
    syntax, size, needed = (header.file_meta.TransferSyntaxUID, path.stat().st_size,
                            rows * columns * count * allocated // 8)
    if not syntax.is_encapsulated:
        if needed > size:
            raise BadDicom(f'{path}: truncated: {count} frames of {columns}x{rows} px need {needed} bytes, '
                           f'the file has {size}')
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
        raise BadDicom(f'{path}: {count} frames of {columns}x{rows} px are more than {MAX_RATIO} times as large '
                       'as the file')
