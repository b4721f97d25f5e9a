"""Image messages: every encoding, byte order and padding, against bytes written by hand."""

import array
import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from msg_adapters.images import ENCODINGS, BadImage, array_to_image, compressed_to_array, grey, image_to_array
from msg_adapters.messages import stamp_ns


def image(encoding, rows, step, *, width, big=False, height=None):
    """Any object with the fields of sensor_msgs/Image; `rows` are bytes, padded to `step`."""
    data = b''.join(row + b'\xee' * (step - len(row)) for row in rows)
    return SimpleNamespace(encoding=encoding, height=len(rows) if height is None else height, width=width, step=step,
                           is_bigendian=int(big), data=data)


@pytest.mark.parametrize('padding', [0, 1, 5])
@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_8_bit(encoding, padding):
    got = image_to_array(image(encoding, [bytes([1, 2, 250]), bytes([4, 5, 6])], 3 + padding, width=3))
    assert got.dtype == np.uint8
    assert got.tolist() == [[1, 2, 250], [4, 5, 6]]


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('padding', [0, 1, 6])      # an odd step puts every other row at an odd address
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_16_bit_in_either_byte_order_keeps_every_bit(encoding, padding, big):
    rows = [[1, 256], [65535, 4096], [4095, 0x1234]]
    packed = [struct.pack('>2H' if big else '<2H', *row) for row in rows]
    got = image_to_array(image(encoding, packed, 4 + padding, width=2, big=big))
    assert got.dtype == np.uint16 and got.dtype.isnative
    assert got.tolist() == rows


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('padding', [0, 2])
def test_float_in_either_byte_order(padding, big):
    rows = [[0.5, -2.0, 1e6], [0.0, 3.25, 7.0]]
    packed = [struct.pack('>3f' if big else '<3f', *row) for row in rows]
    got = image_to_array(image('32FC1', packed, 12 + padding, width=3, big=big))
    assert got.dtype == np.float32 and got.dtype.isnative
    assert got.tolist() == rows


@pytest.mark.parametrize('padding', [0, 2])
def test_colour_becomes_grey_by_its_luminance(padding):
    # ITU-R BT.601: 0.299 R + 0.587 G + 0.114 B; blue, green, red, white
    row = bytes([255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255])
    assert image_to_array(image('bgr8', [row], 12 + padding, width=4)).tolist() == [[29, 150, 76, 255]]
    assert image_to_array(image('rgb8', [row], 12 + padding, width=4)).tolist() == [[76, 150, 29, 255]]


@pytest.mark.parametrize('padding', [0, 3])
def test_colour_with_transparency(padding):
    row = bytes([255, 0, 0, 9, 0, 255, 0, 9, 0, 0, 255, 0, 255, 255, 255, 0])
    assert image_to_array(image('bgra8', [row], 16 + padding, width=4)).tolist() == [[29, 150, 76, 255]]
    assert image_to_array(image('rgba8', [row], 16 + padding, width=4)).tolist() == [[76, 150, 29, 255]]


@pytest.mark.parametrize('padding', [0, 2, 5])
@pytest.mark.parametrize('encoding, luminance', [('uyvy', 1), ('yuv422', 1), ('yuyv', 0), ('yuv422_yuy2', 0)])
def test_of_luminance_and_colour_in_turn_the_luminance_is_taken(encoding, luminance, padding):
    rows = [[1, 2, 250, 4], [16, 235, 0, 255]]
    packed = [bytes(v for y in row for v in ((77, y) if luminance else (y, 77))) for row in rows]
    assert image_to_array(image(encoding, packed, 8 + padding, width=4)).tolist() == rows


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('encoding', ['nv12', 'nv21'])
def test_of_luminance_before_colour_the_luminance_is_taken(encoding, padding):
    rows = [[1, 2, 250, 4], [16, 235, 0, 255]]
    msg = image(encoding, [*map(bytes, rows), bytes([77] * 4)], 4 + padding, width=4, height=2)
    assert image_to_array(msg).tolist() == rows
    msg.data = msg.data[:2 * msg.step]
    with pytest.raises(BadImage, match=f'data has {2 * msg.step} bytes, but 3 rows of step {msg.step} need '
                                       f'{3 * msg.step}'):
        image_to_array(msg)


def test_pixels_that_come_in_twos_need_an_even_width():
    with pytest.raises(BadImage, match='uyvy pixels come in twos, but the image is 3 wide'):
        image_to_array(image('uyvy', [bytes(6)], 6, width=3))


def test_the_last_row_may_come_without_its_padding():
    msg = image('mono8', [b'\x01\x02', b'\x03\x04'], 4, width=2)
    msg.data = msg.data[:6]
    assert image_to_array(msg).tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize('data', [bytes(6), array.array('B', bytes(6)), np.zeros(6, np.uint8), memoryview(bytes(6))],
                         ids=lambda d: type(d).__name__)
def test_does_not_copy_what_it_need_not(data):
    got = image_to_array(SimpleNamespace(encoding='mono8', height=2, width=3, step=3, is_bigendian=0, data=data))
    assert np.shares_memory(got, np.frombuffer(data, np.uint8))
    assert not got.flags.writeable      # the memory is the message's


@pytest.mark.parametrize('change, says', [
    (dict(encoding='bayer_rggb8'), 'bayer_rggb8.*mono16'),
    (dict(encoding=''), 'encoding ""'),
    (dict(width=0), '0x2'),
    (dict(height=0), '3x0'),
    (dict(step=2), 'step 2 is too small'),
    (dict(step=0), 'step 0 is too small'),
    (dict(data=bytes(5)), 'data has 5 bytes.*need 6'),
    (dict(data=bytes(7)), 'data has 7 bytes'),
    (dict(data=b''), 'data has 0 bytes'),
    (dict(height=2**32 - 1), 'data has 6 bytes'),
    (dict(width=2**32 - 1, step=2**32 - 1), 'data has 6 bytes'),
    (dict(encoding='mono16'), 'step 3 is too small: 3 mono16 pixels need 6 bytes'),
], ids=str)
def test_a_bad_image_is_named(change, says):
    good = dict(encoding='mono8', height=2, width=3, step=3, is_bigendian=0, data=bytes(6))
    image_to_array(SimpleNamespace(**good))
    with pytest.raises(BadImage, match=says):
        image_to_array(SimpleNamespace(**(good | change)))


@pytest.mark.parametrize('value', [float('nan'), float('inf'), float('-inf')])
def test_values_that_are_not_finite_are_refused(value):
    with pytest.raises(BadImage, match='1 pixels are not finite'):
        image_to_array(image('32FC1', [struct.pack('<2f', 1.0, value)], 8, width=2))


@pytest.mark.parametrize('dtype, encoding', [(np.uint8, 'mono8'), (np.uint16, 'mono16'), (np.float32, '32FC1'),
                                             ('>u2', 'mono16'), ('>f4', '32FC1')])
def test_there_and_back(new, dtype, encoding):
    pixels = (np.arange(12).reshape(3, 4) * 20).astype(dtype)
    msg = array_to_image(pixels[:, ::-1], 3_000_000_042, 'plane_a', new)   # not contiguous
    assert (msg.encoding, msg.height, msg.width, msg.step) == (encoding, 3, 4, 4 * pixels.dtype.itemsize)
    assert (stamp_ns(msg), msg.header.frame_id) == (3_000_000_042, 'plane_a')
    assert image_to_array(msg).tolist() == pixels[:, ::-1].tolist()


def test_colour_is_written_as_bgr8(new):
    msg = array_to_image(np.full((2, 3, 3), (255, 0, 0), np.uint8), 1, '', new)
    assert (msg.encoding, msg.step, len(msg.data)) == ('bgr8', 9, 18)
    assert image_to_array(msg).tolist() == [[29] * 3] * 2


@pytest.mark.parametrize('array', [np.zeros((2, 2)), np.zeros((2, 2, 4), np.uint8), np.zeros((0, 2), np.uint8),
                                   np.zeros(4, np.uint8), np.zeros((2, 2), bool)],
                         ids=lambda a: f'{a.dtype}{a.shape}')
def test_no_message_is_made_of_what_no_encoding_can_hold(array, new):
    with pytest.raises(BadImage, match='no image encoding'):
        array_to_image(array, 1, '', new)


def compressed_message(new, data, format_='png'):
    return new('sensor_msgs/msg/CompressedImage', format=format_, data=np.frombuffer(data, np.uint8))


def compressed(new, suffix, array):
    return compressed_message(new, cv2.imencode(suffix, array)[1], suffix[1:])


def test_compressed_png_keeps_16_bits(new):
    pixels = np.array([[0, 256, 65535], [1, 4095, 4096]], np.uint16)
    got = compressed_to_array(compressed(new, '.png', pixels))
    assert got.dtype == np.uint16
    assert got.tolist() == pixels.tolist()


def test_compressed_jpeg(new):
    got = compressed_to_array(compressed(new, '.jpg', np.full((16, 24), 77, np.uint8)))
    assert got.shape == (16, 24)
    assert np.abs(got.astype(int) - 77).max() <= 1


def test_compressed_colour_becomes_grey(new):
    got = compressed_to_array(compressed(new, '.png', np.full((2, 3, 3), (0, 0, 255), np.uint8)))
    assert got.tolist() == [[76] * 3] * 2


@pytest.mark.parametrize('format_', ['png', 'mono16; png compressed mono16', '16UC1; png compressed ',
                                     'mono16;png compressed', ''])
def test_the_data_says_what_it_is_whatever_the_format_field_says(new, format_):
    pixels = np.array([[0, 256, 65535], [1, 4095, 4096]], np.uint16)
    got = compressed_to_array(compressed_message(new, cv2.imencode('.png', pixels)[1], format_))
    assert got.dtype == np.uint16 and got.tolist() == pixels.tolist()


@pytest.mark.parametrize('format_', ['jpeg', 'mono8; jpeg compressed bgr8', 'bgr8; jpeg compressed bgr8'])
def test_a_colour_jpeg_of_a_grey_camera(new, format_):
    pixels = np.full((16, 24, 3), 77, np.uint8)
    got = compressed_to_array(compressed_message(new, cv2.imencode('.jpg', pixels)[1], format_))
    assert got.shape == (16, 24) and got.dtype == np.uint8 and np.abs(got.astype(int) - 77).max() <= 1


PNG = cv2.imencode('.png', np.arange(4096, dtype=np.uint16).reshape(64, 64))[1].tobytes()
JPEG = cv2.imencode('.jpg', np.arange(4096).reshape(64, 64).astype(np.uint8))[1].tobytes()


@pytest.mark.parametrize('data, says', [
    (b'', 'neither PNG nor JPEG'),
    (b'no image at all', 'neither PNG nor JPEG'),
    (bytes(12) + PNG, 'neither PNG nor JPEG'),      # as compressedDepth sends it
    (PNG[:8], 'cut short or damaged after 8 of 8 bytes'),
    (PNG[:60], 'cut short or damaged'),
    (PNG[:-20], 'cut short or damaged'),
    (PNG[:200] + bytes([PNG[200] ^ 255]) + PNG[201:], 'decoded'),
    (b'\xff\xd8\xff\xe0' + bytes(20), 'no complete JPEG header'),
    (JPEG[:len(JPEG) // 2], 'cut short'),
    (JPEG[:-2], 'cut short'),
    (b'II*\0' + bytes(100), 'neither PNG nor JPEG'),
], ids=lambda value: value if isinstance(value, str) else f'{len(value)} bytes')
def test_compressed_data_that_is_no_image_is_refused(new, data, says):
    with pytest.raises(BadImage, match=f'compressed image .format "png", {len(data)} bytes.*{says}'):
        compressed_to_array(compressed_message(new, data))


@pytest.mark.parametrize('width, height', [(30000, 30000), (2**31 - 1, 2**31 - 1), (8193, 8192)])
def test_a_small_file_that_says_it_is_huge_is_refused_before_it_is_decoded(new, monkeypatch, width, height):
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    png = PNG[:16] + struct.pack('>II', width, height) + PNG[24:]
    with pytest.raises(BadImage, match=f'{width}x{height} pixels'):
        compressed_to_array(compressed_message(new, png))
    if width < 65536:
        at = JPEG.index(b'\xff\xc0')
        jpeg = JPEG[:at + 5] + struct.pack('>HH', height, width) + JPEG[at + 9:]
        with pytest.raises(BadImage, match=f'{width}x{height} pixels'):
            compressed_to_array(compressed_message(new, jpeg, 'jpeg'))


def test_grey_drops_transparency_and_refuses_strange_pixels():
    assert grey(np.full((1, 1, 4), (255, 0, 0, 9), np.uint8)).tolist() == [[29]]
    assert grey(np.full((1, 1, 1), 9, np.uint16)).tolist() == [[9]]
    with pytest.raises(BadImage, match='float64'):
        grey(np.zeros((2, 2)))
    with pytest.raises(BadImage, match='shape'):
        grey(np.zeros((2, 2, 2), np.uint8))


def test_every_encoding_of_the_table_reads():
    for name, e in ENCODINGS.items():
        item = e.dtype.itemsize * e.channels
        assert image_to_array(image(name, [bytes(2 * item)], 2 * item, width=2)).shape == (1, 2)
