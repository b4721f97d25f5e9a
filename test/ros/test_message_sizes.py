"""What is too large is not kept, but named."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from fluoro_shape_ros.ros.message_sizes import MAX_BYTES, Oversized, bounded
from fluoro_shape_ros.ros.worker import decode
from msg_adapters.images import MAX_PIXELS, BadImage


def image(height, width, data=b''):
    return SimpleNamespace(header='head', encoding='mono8', height=height, width=width, step=width, is_bigendian=0,
                           data=data)


@pytest.mark.parametrize('msg, says', [
    (image(46341, 46341), '46341x46341 pixels'),
    (image(2**32 - 1, 2**32 - 1), '4294967295x4294967295 pixels'),
    (image(4097, 4096), '4096x4097 pixels'),
    (image(10, 10, np.zeros(MAX_BYTES + 1, np.uint8)), f'{MAX_BYTES + 1} bytes'),
    (SimpleNamespace(header='head', format='png', data=np.zeros(MAX_BYTES + 1, np.uint8)), f'{MAX_BYTES + 1} bytes'),
], ids=['2 GB', 'absurd', 'a row too many', 'data', 'compressed'])
def test_what_is_too_large_is_let_go_and_named(msg, says):
    kept = bounded(msg)
    assert isinstance(kept, Oversized) and kept.header == 'head'
    with pytest.raises(BadImage, match=says):
        decode(kept)


def test_what_is_not_goes_through():
    for msg in (image(4096, 4096), image(0, 0), SimpleNamespace(header='head', format='png', data=b'')):
        assert bounded(msg) is msg


def test_a_small_file_may_hold_a_large_image():
    data = cv2.imencode('.png', np.zeros((MAX_PIXELS // 64 + 1, 64), np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    assert len(data) < MAX_PIXELS / 50
    with pytest.raises(BadImage, match='pixels are more'):
        decode(SimpleNamespace(header='head', format='png', data=data))


def png(**damage):
    """A PNG of 8 x 6; `damage`: place=bytes."""
    data = bytearray(cv2.imencode('.png', np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes())
    for place, value in damage.items():
        at = data.index(place.encode())
        data[at - 4:at] = value
    return bytes(data)


@pytest.mark.parametrize('data, says', [
    # found by fuzz.py: 2 GB and seconds in OpenCV 5
    (png(IDAT=b'\x7f\xff\xff\x00'), 'cut short or damaged after 33 of'),
    (png()[:-1], 'cut short'),
    (png()[:20], 'cut short'),
    (png().replace(b'IHDR\0\0\0\x08\0\0\0\x06', b'IHDR\0\1\0\0\0\1\0\0'), '65536x65536 pixels'),
])
def test_a_png_that_promises_more_than_it_holds_is_refused_before_it_is_read(data, says):
    for kind in (bytes, bytearray, lambda d: np.frombuffer(d, np.uint8)):
        with pytest.raises(BadImage, match=says):
            decode(SimpleNamespace(header='head', format='png', data=kind(data)))


def test_a_good_png_is_read():
    assert (decode(SimpleNamespace(header='head', format='png', data=png() + b'more')).tolist()
            == np.arange(48).reshape(6, 8).tolist())
