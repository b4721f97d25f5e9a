"""Whoever publishes must not decide how much memory and time the node takes: what is too large is not kept, but named."""

from __future__ import annotations

from dataclasses import dataclass

from msg_adapters.images import BadImage

MAX_PIXELS = 2**24      # 4096 x 4096, finer than X-ray detectors are: reconstructing a pair of these takes some seconds and 1.2 GB
PNG = b'\x89PNG\r\n\x1a\n'
MAX_BYTES = 4 * MAX_PIXELS


@dataclass(frozen=True)
class Oversized:
    """Stands in for an image message that is too large to be kept."""

    header: object
    reason: str


def bounded(msg):
    """The sensor_msgs/Image or CompressedImage, or an Oversized in its place."""
    try:
        if hasattr(msg, 'encoding'):
            check_pixels(msg.height, msg.width)
        if len(msg.data) > MAX_BYTES:
            raise BadImage(f'{len(msg.data)} bytes of data are more than {MAX_BYTES}')
    except BadImage as error:
        return Oversized(msg.header, str(error))
    return msg


def check_png(data) -> None:
    """Raises BadImage where a PNG promises more than it holds: OpenCV makes room for what a chunk's length says, 2 GB for 80 bytes.

    Any other data passes. Chunks: ISO/IEC 15948, 5.3.
    """
    data = memoryview(data).cast('B')
    if data[:8] != PNG:
        return
    at = len(PNG)
    while at + 12 <= len(data):
        length, name = int.from_bytes(data[at:at + 4], 'big'), bytes(data[at + 4:at + 8])
        if length > len(data) - at - 12:
            break
        if name == b'IHDR' and length >= 8:
            check_pixels(int.from_bytes(data[at + 12:at + 16], 'big'), int.from_bytes(data[at + 8:at + 12], 'big'))
        if name == b'IEND':
            return
        at += 12 + length
    raise BadImage(f'the compressed image is a PNG that is cut short or damaged after {at} of {len(data)} bytes')


def check_pixels(height: int, width: int) -> None:
    """Raises BadImage where an image is too large to be looked at."""
    if height * width > MAX_PIXELS:
        raise BadImage(f'{width}x{height} pixels are more than {MAX_PIXELS}')
