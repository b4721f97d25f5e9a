"""The pixels of an XA run, frame by frame."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from .dicom import XaRun
from .dicom_frames import check_whole, compressed_frames
from .dicom_header import BadDicom, one_line, reading, words

DECODER = 'fluoro_shape_ros.files.dicom_decoder'


@dataclass(frozen=True)
class Table:
    """What stored values mean."""

    first: int              # the stored value, as `stored_values` has it, ...
    values: np.ndarray      # (N,) uint8 or uint16, ... that means the first of these
    bits: int               # that these have


def pictures(run: XaRun) -> Iterator[np.ndarray]:
    """The (H, W) uint8 or uint16 frames as stored: windows are for displays and not applied; MONOCHROME1, which is
    INVERSE by another name, is turned over, so that the device is dark.

    Values that are logarithms of the intensity (LOG) become intensities where the file has the table for it
    (Modality LUT), else they stay. Raises BadDicom where a frame can't be decoded.
    """
    header, table, number = run.header, modality_table(run), 0
    full = 2 ** (table.bits if table else stored_bits(header)) - 1
    inverse = header.PhotometricInterpretation == 'MONOCHROME1' or words(header, 'PresentationLUTShape') == ['INVERSE']
    check_frames(run)
    for frame in decoded(run) if header.file_meta.TransferSyntaxUID.is_encapsulated else uncompressed(run):
        frame, number = stored_values(frame, header), number + 1
        if table:
            frame = table.values[np.clip(frame.astype(np.int32) - table.first, 0, len(table.values) - 1)]
        yield np.ascontiguousarray(full - frame if inverse else frame)
    if number != run.count:
        raise BadDicom(f'{run.path}: truncated: {number} of {run.count} frames are there')
    if header.file_meta.TransferSyntaxUID.is_encapsulated:
        check_whole(run.path, header, run.count)


def uncompressed(run: XaRun) -> Iterator[np.ndarray]:
    """The frames as they are in the file, bits and all. Raises BadDicom."""
    from pydicom.pixels import iter_pixels

    with reading(run.path, 'its frames'):       # pydicom takes the lowest BitsStored bits wherever HighBit is
        yield from iter_pixels(run.path, indices=range(run.count), raw=True, bits_stored=int(run.header.BitsAllocated),
                               transfer_syntax_uid=run.header.file_meta.TransferSyntaxUID)


def decoded(run: XaRun) -> Iterator[np.ndarray]:
    """The frames of a compressed run, see dicom_decoder. Raises BadDicom."""
    with tempfile.TemporaryFile() as said, subprocess.Popen([sys.executable, '-m', DECODER, str(run.path),
                                                             str(run.count)], stdout=subprocess.PIPE,
                                                            stderr=said) as child:
        number = 0
        try:
            while child.stdout.peek(1):     # type: ignore[attr-defined]
                # see dicom_decoder
                yield np.lib.format.read_array(SimpleNamespace(read=child.stdout.read), allow_pickle=False)
                number += 1
        except (ValueError, EOFError):     # it ended in the middle of a frame
            pass
        finally:
            child.stdout.close()
            code = child.wait()
        if code:
            said.seek(0)
            why = (one_line((said.read().decode(errors='replace').splitlines() or [''])[-1])
                   if code > 0 else 'its decoder crashed')
            raise BadDicom(f'{run.path}: frame {number + 1} can\'t be decoded ({why})')


def modality_table(run: XaRun) -> Table | None:
    """The file's own table from logarithms to intensities; None where it has none, or values that are something else.
    Raises BadDicom."""
    header = run.header
    if header.get('PixelIntensityRelationship') != 'LOG' or not header.get('ModalityLUTSequence'):
        return None
    words = '<u2' if header.file_meta.TransferSyntaxUID.is_little_endian else '>u2'
    with reading(run.path, 'its Modality LUT'):
        item = header.ModalityLUTSequence[0]
        descriptor, data = np.atleast_1d(item.LUTDescriptor), item.LUTData
        data = np.frombuffer(data, words) if isinstance(data, bytes) else np.atleast_1d(data)
    if (descriptor.shape != (3,) or descriptor.dtype.kind not in 'iu' or data.dtype.kind not in 'iu'
            or not 8 <= descriptor[2] <= 16):
        raise BadDicom(f'{run.path}: its Modality LUT is no table of 8 to 16 bits')
    entries, first, bits = descriptor.tolist()
    if len(data) != (entries or 2**16) or data.min() < 0 or data.max() >= 2**bits:
        raise BadDicom(f'{run.path}: its Modality LUT has other values than it says')
    raised = 2 ** (stored_bits(header) - 1) if header.get('PixelRepresentation') else 0
    return Table(first + raised, data.astype(np.uint8 if bits == 8 else np.uint16), bits)


def stored_bits(header) -> int:
    return int(header.get('BitsStored') or header.BitsAllocated)


def stored_values(frame: np.ndarray, header) -> np.ndarray:
    """The unsigned values in the bits from HighBit down; signed ones are raised so that the lowest is 0."""
    bits, dtype = stored_bits(header), np.uint8 if int(header.BitsAllocated) == 8 else np.uint16
    shift = int(header.get('HighBit') or bits - 1) + 1 - bits
    values = (frame.astype(frame.dtype.newbyteorder('='), copy=False).view(dtype)    # type: ignore[operator]
              >> dtype(shift)) & dtype(2**bits - 1)
    return values ^ dtype(2 ** (bits - 1)) if header.get('PixelRepresentation') else values


def check_frames(run: XaRun) -> None:
    """Raises BadDicom where a compressed frame says that it is larger than the file says: it would be unpacked to that
    size."""
    from pydicom.uid import RLELossless

    declared = int(run.header.Columns), int(run.header.Rows), 1
    if (run.header.file_meta.TransferSyntaxUID == RLELossless
            or not run.header.file_meta.TransferSyntaxUID.is_encapsulated):
        return      # which say nothing else
    for number, frame in enumerate(compressed_frames(run.path, run.header, run.count), 1):
        found = codestream_size(frame)
        if found is None:
            raise BadDicom(f'{run.path}: frame {number} can\'t be decoded: it does not say how large it is')
        if found != declared:
            inside = f'{found[0]}x{found[1]} px' + (f' of {found[2]} colours' if found[2] != 1 else '')
            raise BadDicom(f'{run.path}: frame {number} is {inside} inside, '
                           f'but {declared[0]}x{declared[1]} by the header')


def codestream_size(frame: bytes) -> tuple[int, int, int] | None:
    """(columns, rows, components) by a JPEG, JPEG-LS or JPEG 2000 codestream itself; None for any other."""
    number = lambda at, size: int.from_bytes(frame[at:at + size], 'big')       # noqa: E731
    if frame[:4] == b'\xff\x4f\xff\x51':    # SIZ (ITU-T T.800 A.5.1)
        return number(8, 4) - number(16, 4), number(12, 4) - number(20, 4), number(40, 2)
    at = 2
    while frame[:2] == b'\xff\xd8' and at + 9 < len(frame) and frame[at] == 0xff:
        marker = frame[at + 1]
        # SOF (T.81 B.2.2, T.87 C.2.2)
        if marker == 0xf7 or (0xc0 <= marker <= 0xcf and marker not in (0xc4, 0xc8, 0xcc)):
            return number(at + 7, 2), number(at + 5, 2), frame[at + 9]
        at += 1 if marker == 0xff else 2 + number(at + 2, 2)    # 0xff: filled up before a marker
    return None
