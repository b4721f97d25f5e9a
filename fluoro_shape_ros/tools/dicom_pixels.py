"""The pixels of an XA run, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .dicom import BadDicom, XaRun


def pictures(run: XaRun) -> Iterator[np.ndarray]:
    """The (H, W) uint8 or uint16 frames as stored: windows are for displays and not applied, MONOCHROME1 is turned over, so that the device is dark.

    Values that are logarithms of the intensity (LOG) become intensities where the file has the table for it (Modality LUT), else they stay.
    Raises BadDicom where a frame can't be decoded.
    """
    from pydicom.pixels import apply_modality_lut, iter_pixels

    header = run.header
    lut = header.get('PixelIntensityRelationship') == 'LOG' and bool(header.get('ModalityLUTSequence'))
    full = 2 ** (int(header.ModalityLUTSequence[0].LUTDescriptor[2]) if lut else stored_bits(header)) - 1
    check_frames(run)
    # pydicom takes the lowest BitsStored bits of uncompressed pixels wherever HighBit is
    all_bits = {} if header.file_meta.TransferSyntaxUID.is_encapsulated else {'bits_stored': int(header.BitsAllocated)}
    frames, number = iter_pixels(run.path, raw=True, **all_bits), 0
    while True:
        try:
            frame = next(frames, None)
        except Exception as error:      # the last line of defence: each plug-in fails in its own way
            raise BadDicom(f'{run.path}: frame {number + 1} can\'t be decoded ({type(error).__name__}: {" ".join(str(error).split())[:200]})') from error
        if frame is None:
            break
        frame, number = stored_values(frame, header), number + 1
        if lut:
            frame = apply_modality_lut(frame, header)
        yield np.ascontiguousarray(full - frame if header.PhotometricInterpretation == 'MONOCHROME1' else frame)
    if number != len(run.calibrations):
        raise BadDicom(f'{run.path}: truncated: {number} of {len(run.calibrations)} frames are there')


def stored_bits(header) -> int:
    return int(header.get('BitsStored') or header.BitsAllocated)


def stored_values(frame: np.ndarray, header) -> np.ndarray:
    """The unsigned values in the bits from HighBit down; signed ones are raised so that the lowest is 0."""
    bits, dtype = stored_bits(header), np.uint8 if int(header.BitsAllocated) == 8 else np.uint16
    shift = int(header.get('HighBit') or bits - 1) + 1 - bits
    values = (frame.view(dtype) >> dtype(shift)) & dtype(2**bits - 1)
    return values ^ dtype(2 ** (bits - 1)) if header.get('PixelRepresentation') else values


def check_frames(run: XaRun) -> None:
    """Raises BadDicom where a compressed frame says that it is larger than the file says: it would be unpacked to that size."""
    import pydicom
    from pydicom.encaps import generate_frames
    from pydicom.tag import Tag

    if not run.header.file_meta.TransferSyntaxUID.is_encapsulated:
        return
    declared = int(run.header.Columns), int(run.header.Rows)
    with run.path.open('rb') as file:
        pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[Tag('Rows')])
        file.seek(12, 1)        # tag, VR and length of the pixel data
        try:
            for number, frame in enumerate(generate_frames(file, number_of_frames=len(run.calibrations)), 1):
                found = codestream_size(frame)
                if found not in (None, declared):
                    raise BadDicom(f'{run.path}: frame {number} is {found[0]}x{found[1]} px inside, but {declared[0]}x{declared[1]} by the header')
        except BadDicom:
            raise
        except Exception as error:      # as in _header
            raise BadDicom(f'{run.path}: truncated: its compressed frames can\'t be read ({type(error).__name__})') from error


def codestream_size(frame: bytes) -> tuple[int, int] | None:
    """(columns, rows) by a JPEG, JPEG-LS or JPEG 2000 codestream itself; None for any other."""
    number = lambda at, size: int.from_bytes(frame[at:at + size], 'big')       # noqa: E731
    if frame[:4] == b'\xff\x4f\xff\x51':    # SIZ (ITU-T T.800 A.5.1)
        return number(8, 4) - number(16, 4), number(12, 4) - number(20, 4)
    at = 2
    while frame[:2] == b'\xff\xd8' and at + 9 < len(frame) and frame[at] == 0xff:
        marker = frame[at + 1]
        if marker == 0xf7 or (0xc0 <= marker <= 0xcf and marker not in (0xc4, 0xc8, 0xcc)):     # SOF (T.81 B.2.2, T.87 C.2.2)
            return number(at + 7, 2), number(at + 5, 2)
        at += 2 + number(at + 2, 2)
    return None
