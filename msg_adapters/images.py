"""sensor_msgs/Image and CompressedImage to arrays and back.

Any object with the fields of the message will do: rclpy's and rosbags' messages alike. Grey values keep their depth;
nothing is scaled or cut to 8 bits.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .messages import New, header, short


class BadImage(ValueError):
    """An image message that can't be what it says; the message tells why."""


@dataclass(frozen=True)
class _Encoding:
    dtype: np.dtype
    channels: int = 1
    to_grey: int | None = None      # OpenCV colour conversion


_U8, _U16, _F32 = np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32)
ENCODINGS = {
    'mono8': _Encoding(_U8),
    '8UC1': _Encoding(_U8),
    'mono16': _Encoding(_U16),
    '16UC1': _Encoding(_U16),
    '32FC1': _Encoding(_F32),
    'bgr8': _Encoding(_U8, 3, cv2.COLOR_BGR2GRAY),
    'rgb8': _Encoding(_U8, 3, cv2.COLOR_RGB2GRAY),
    'bgra8': _Encoding(_U8, 4, cv2.COLOR_BGRA2GRAY),
    'rgba8': _Encoding(_U8, 4, cv2.COLOR_RGBA2GRAY),
    # luminance and half as much colour, two pixels in four bytes
    'uyvy': _Encoding(_U8, 2, cv2.COLOR_YUV2GRAY_UYVY),
    'yuv422': _Encoding(_U8, 2, cv2.COLOR_YUV2GRAY_UYVY),
    'yuyv': _Encoding(_U8, 2, cv2.COLOR_YUV2GRAY_YUY2),
    'yuv422_yuy2': _Encoding(_U8, 2, cv2.COLOR_YUV2GRAY_YUY2),
}
LUMINANCE_FIRST = ('nv12', 'nv21')      # all of it, and then half as many rows of colour
MAX_PIXELS = 2**24      # 4096 x 4096, finer than X-ray detectors are: reconstructing a pair of these takes some seconds
                        # and 1.2 GB
MAX_PARTS = 2**16       # of a file, that are looked at: a PNG of that size has some thousand chunks
# by dtype and number of dimensions
_WRITTEN_AS = {(_U8, 2): 'mono8', (_U16, 2): 'mono16', (_F32, 2): '32FC1', (_U8, 3): 'bgr8'}


def check_pixels(height: int, width: int) -> None:
    """Raises BadImage where an image has more than MAX_PIXELS."""
    if height * width > MAX_PIXELS:
        raise BadImage(f'{width}x{height} pixels are more than {MAX_PIXELS}')


def image_to_array(msg: Any) -> np.ndarray:
    """(H, W) uint8, uint16 or float32 in native byte order, from a sensor_msgs/Image.

    A read-only view of the message's memory where that is possible: one channel, native byte order, aligned.
    Raises BadImage for an unknown encoding, zero size, step or data length that do not fit, more than MAX_PIXELS, and
    values that are not finite.
    """
    if msg.encoding not in ENCODINGS and msg.encoding not in LUMINANCE_FIRST:
        raise BadImage(f'encoding "{short(msg.encoding)}" is not one of {", ".join((*ENCODINGS, *LUMINANCE_FIRST))}')
    encoding = ENCODINGS.get(msg.encoding, ENCODINGS['mono8'])
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if height == 0 or width == 0:
        raise BadImage(f'the image is empty: {width}x{height}')
    item = encoding.dtype.itemsize * encoding.channels
    if step < width * item:
        raise BadImage(f'step {step} is too small: {width} {msg.encoding} pixels need {width * item} bytes a row')
    if encoding.channels == 2 and width % 2:
        raise BadImage(f'{msg.encoding} pixels come in twos, but the image is {width} wide')
    size, rows = len(msg.data), height + (height + 1) // 2 if msg.encoding in LUMINANCE_FIRST else height
    # the last row may come without its padding
    if not (rows - 1) * step + width * item <= size <= rows * step:
        raise BadImage(f'data has {size} bytes, but {rows} rows of step {step} need {rows * step}')
    check_pixels(height, width)
    strides = (step, item, encoding.dtype.itemsize)
    # np.ndarray rather than reshape: a step need not be a multiple of the item size
    array: np.ndarray = np.ndarray((height, width, encoding.channels),
                                   encoding.dtype.newbyteorder('>' if msg.is_bigendian else '<'), _bytes(msg.data),
                                   strides=strides)
    array = np.require(array, encoding.dtype, 'A')      # to native order and alignment, a copy only where they differ
    if encoding.to_grey is not None:
        return cv2.cvtColor(np.ascontiguousarray(array), encoding.to_grey)
    return _checked(array[:, :, 0])


def _bytes(data: Any) -> memoryview:
    """The buffer of a message's data, read-only and without copying it: array.array, ndarray, bytes and memoryview
    alike."""
    return np.frombuffer(data, np.uint8).data.toreadonly()


def _checked(array: np.ndarray) -> np.ndarray:
    # min and max carry NaN and infinity along, at a fraction of the cost of isfinite over all pixels
    if array.dtype.kind == 'f' and not np.isfinite([array.min(), array.max()]).all():
        raise BadImage(f'{int((~np.isfinite(array)).sum())} pixels are not finite')
    return array


def compressed_to_array(msg: Any) -> np.ndarray:
    """(H, W) uint8 or uint16 from a sensor_msgs/CompressedImage that holds a PNG (8 or 16 bits) or a JPEG; colour
    becomes grey.

    The data says what it is; `format` ("png", "mono16; png compressed mono16", ...) is not believed. Raises BadImage
    for any other data, for what can't be decoded or is cut short, and, before decoding it, for what says that it has
    more than MAX_PIXELS.
    """
    try:
        data = np.frombuffer(msg.data, np.uint8)
        _check_announced(data)
        array = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if array is None:
            raise BadImage('can\'t be decoded')
    except cv2.error as error:
        raise BadImage(f'{_name(msg)}: can\'t be decoded: {error.err}') from error
    except BadImage as error:
        raise BadImage(f'{_name(msg)}: {error}') from None
    return grey(array)


def _name(msg: Any) -> str:
    return f'the compressed image (format "{short(msg.format)}", {len(msg.data)} bytes)'


def _check_announced(data: np.ndarray) -> None:
    """Raises BadImage, without decoding it, where a PNG or JPEG says that it is too large or ends too early, and for
    any other data."""
    if data[:8].tobytes() == b'\x89PNG\r\n\x1a\n':
        _check_png(data)
    elif data[:3].tobytes() == b'\xff\xd8\xff':
        _check_jpeg(data)
    else:
        raise BadImage('neither PNG nor JPEG')


def _check_png(data: np.ndarray) -> None:
    """All chunks (ISO/IEC 15948, 5.3 and 11.2.2): OpenCV makes room for whatever length one says it has, 2 GB for 80
    bytes."""
    at = 8
    for _ in range(MAX_PARTS):
        if at + 12 > len(data):
            break
        length, name = struct.unpack_from('>I4s', data, at)
        if length > len(data) - at - 12:
            break
        if name == b'IHDR' and length >= 8:
            width, height = struct.unpack_from('>II', data, at + 8)
            check_pixels(height, width)
        if name == b'IEND':
            return
        at += 12 + length
    raise BadImage(f'a PNG that is cut short or damaged after {at} of {len(data)} bytes')


def _check_jpeg(data: np.ndarray) -> None:
    """The segments up to the start of the frame (ITU-T T.81, B.2.2), and whether there is an end."""
    at = 2
    for _ in range(MAX_PARTS):
        if at + 9 > len(data) or data[at] != 0xff:
            break
        marker, length = struct.unpack_from('>BH', data, at + 1)
        if 0xc0 <= marker <= 0xcf and marker not in (0xc4, 0xc8, 0xcc):     # start of frame
            height, width = struct.unpack_from('>HH', data, at + 5)
            check_pixels(height, width)
            # end of image: without it, OpenCV 4 fills what is missing with grey
            if data[at:].tobytes().rfind(b'\xff\xd9') < 0:
                raise BadImage('a JPEG that is cut short')
            return
        at += 1 if marker == 0xff else 2 + length
    raise BadImage('no complete JPEG header')


def grey(array: np.ndarray) -> np.ndarray:
    """(H, W) of an image as OpenCV reads it: grey, BGR or BGRA; uint8, uint16 or float32. Raises BadImage for any
    other."""
    if array.dtype not in (_U8, _U16, _F32):
        raise BadImage(f'pixels of type {array.dtype} are not supported: uint8, uint16 and float32 are')
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    elif array.ndim == 3 and array.shape[2] in (3, 4):
        array = cv2.cvtColor(array, cv2.COLOR_BGR2GRAY if array.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    if array.ndim != 2:
        raise BadImage(f'an array of shape {array.shape} is no image')
    return _checked(array)


def array_to_image(array: np.ndarray, stamp_ns: int, frame_id: str, new: New) -> Any:
    """A sensor_msgs/Image of an (H, W) uint8 (mono8), uint16 (mono16) or float32 (32FC1), or an (H, W, 3) uint8 (bgr8)
    array.

    `new` is a factory (see messages). Raises BadImage for any other array.
    """
    encoding = _WRITTEN_AS.get((array.dtype.newbyteorder('='), array.ndim))
    if encoding is None or 0 in array.shape or (array.ndim == 3 and array.shape[2] != 3):
        raise BadImage(f'no image encoding for an array of type {array.dtype} and shape {array.shape}')
    native = np.ascontiguousarray(array, ENCODINGS[encoding].dtype)
    return new('sensor_msgs/msg/Image', header=header(new, stamp_ns, frame_id), height=array.shape[0],
               width=array.shape[1], encoding=encoding,
               is_bigendian=int(sys.byteorder == 'big'), step=native.strides[0], data=native.reshape(-1).view(np.uint8))
