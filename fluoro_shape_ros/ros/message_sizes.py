"""Whoever publishes must not decide how much memory and time the node takes: what is too large is not kept, but
named."""

from __future__ import annotations

from dataclasses import dataclass

from msg_adapters.images import MAX_PIXELS, BadImage, check_pixels

MAX_BYTES = 4 * MAX_PIXELS     # as 32FC1


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
