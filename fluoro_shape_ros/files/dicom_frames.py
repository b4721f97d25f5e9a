"""Where the frames of a DICOM file are, and how many there are, whatever its header says of that. Needs pydicom
(extra `dicom`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .dicom_header import BadDicom, reading

PIXEL_DATA = b'\xe0\x7f\x10\0'      # (7FE0,0010), little endian
# of JPEG and JPEG-LS (SOI), of JPEG 2000 (SOC, SIZ): nothing inside a frame begins so
STARTS = b'\xff\xd8', b'\xff\x4f\xff\x51'
UNDEFINED = 2**32 - 1

Pieces = list[tuple[int, int]]      # of a frame: where in the file each begins, and how many bytes it has


def count_frames(path: Path, header) -> int:
    """How many frames a file has, of those that are not compressed the whole ones. Raises BadDicom."""
    if header.file_meta.TransferSyntaxUID.is_encapsulated:
        return len(compressed_pieces(path, header))
    begin, length = pixel_data(path, header)
    there = path.stat().st_size - begin
    return ((there if length == UNDEFINED else min(length, there))
            // (int(header.Rows) * int(header.Columns) * int(header.BitsAllocated) // 8))


def pixel_data(path: Path, header) -> tuple[int, int]:
    """Where the value of the pixel data begins in the file, and its length by the file's own account. Raises
    BadDicom."""
    import pydicom
    from pydicom.tag import Tag

    syntax = header.file_meta.TransferSyntaxUID
    with path.open('rb') as file:
        with reading(path, 'its pixels'):
            pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[Tag('Rows')], force=True)
        begin = file.tell()
        element = file.read(8 if syntax.is_implicit_VR else 12)
    if element[:4] != (PIXEL_DATA if syntax.is_little_endian else PIXEL_DATA[1::-1] + PIXEL_DATA[:1:-1]):
        raise BadDicom(f'{path}: has no pixels')
    return begin + len(element), int.from_bytes(element[-4:], 'little' if syntax.is_little_endian else 'big')


def compressed_pieces(path: Path, header) -> list[Pieces]:
    """The frames of a compressed file (PS3.5 A.4). Tables of offsets are not asked, which are often wrong or missing;
    empty fragments are none. Raises BadDicom."""
    from pydicom.encaps import parse_basic_offsets, parse_fragments

    begin, _ = pixel_data(path, header)
    fragments = []
    with path.open('rb') as file:
        file.seek(begin)
        with reading(path, 'its compressed frames'):
            parse_basic_offsets(file)
            _, offsets = parse_fragments(file)
        for at in offsets:
            file.seek(at + 4)
            length, head = int.from_bytes(file.read(4), 'little'), file.read(4)
            if length:
                fragments.append((at + 8, length, head.startswith(STARTS)))
    one_each = not any(starts for _, _, starts in fragments)        # as in RLE
    frames: list[Pieces] = []
    for at, length, starts in fragments:
        if starts or one_each or not frames:
            frames.append([])
        frames[-1].append((at, length))
    return frames


def compressed_frames(path: Path, header, count: int) -> Iterator[bytes]:
    """The first `count` frames as they are in the file; the last one may be cut off. Raises BadDicom."""
    with path.open('rb') as file:
        for frame in compressed_pieces(path, header)[:count]:
            parts = []
            for at, length in frame:
                file.seek(at)
                parts.append(file.read(length))
            yield b''.join(parts)


def check_whole(path: Path, header, count: int) -> None:
    """Raises BadDicom where a compressed file ends in one of its first `count` frames: decoders fill up what is
    missing."""
    if any(at + length > path.stat().st_size for frame in compressed_pieces(path, header)[:count]
           for at, length in frame):
        raise BadDicom(f'{path}: truncated: it ends in its last frame')
