"""Whatever a message says, it becomes what it says or is refused by name: properties over generated input.

`PROPERTY_EXAMPLES=100000 pytest test/msg_adapters/test_properties.py` tries that many for each; the default keeps CI
short, and always the same.
"""

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip('hypothesis')

from generated import examples
from hypothesis import example, given
from hypothesis import strategies as st

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome
from fluoro_shape_ros.geometry.cameras import GeometryError, check_pair
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.ros.worker import camera, checked_camera
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view
from msg_adapters.images import ENCODINGS, BadImage, compressed_to_array, image_to_array
from msg_adapters.shapes import BadPath, path_to_points

UINT32 = st.one_of(st.integers(0, 7), st.integers(0, 2**32 - 1))
ANY = st.one_of(st.floats(width=64), st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e300, float('nan'), float('inf')]))


# ---- images

FORMATS = {1: 'B', 2: 'H', 4: 'f'}


@st.composite
def images(draw):
    """Mostly right Image messages, with whatever can be wrong with one."""
    encoding = draw(st.sampled_from([*ENCODINGS, 'mono12', '']))
    e = ENCODINGS.get(encoding, ENCODINGS['mono8'])
    height, width = draw(st.integers(0, 4)), draw(st.integers(0, 4))
    step = max(0, width * e.dtype.itemsize * e.channels + draw(st.sampled_from([0, 0, 1, 3, -1])))
    size = max(0, height * step + draw(st.sampled_from([0, 0, 0, -1, -3, 1, 1000])))
    data = draw(st.binary(min_size=size, max_size=size))
    fields = dict(encoding=encoding, height=height, width=width, step=step, is_bigendian=draw(st.integers(0, 255)),
                  data=data)
    lie = draw(st.sampled_from([None] * 6 + ['height', 'width', 'step']))
    return SimpleNamespace(**fields | ({lie: draw(UINT32)} if lie else {}))


def by_hand(msg):
    """The channels of every pixel, read one by one; None where the message can't be an image."""
    e = ENCODINGS.get(msg.encoding)
    # two pixels share their colour
    if e is None or not msg.height or not msg.width or (e.channels == 2 and msg.width % 2):
        return None
    item = e.dtype.itemsize * e.channels
    if (msg.step < msg.width * item
            or not (msg.height - 1) * msg.step + msg.width * item <= len(msg.data) <= msg.height * msg.step):
        return None
    form = ('>' if msg.is_bigendian else '<') + str(e.channels) + FORMATS[e.dtype.itemsize]
    pixels = np.array([[struct.unpack_from(form, msg.data, v * msg.step + u * item) for u in range(msg.width)]
                       for v in range(msg.height)])
    return pixels if np.isfinite(pixels).all() else None


@examples(5)
@given(images())
def test_an_image_is_read_as_it_says_or_refused(msg):
    pixels = by_hand(msg)
    if pixels is None:
        with pytest.raises(BadImage):
            image_to_array(msg)
        return
    got = image_to_array(msg)
    assert got.shape == pixels.shape[:2] and got.dtype == ENCODINGS[msg.encoding].dtype and got.dtype.isnative
    if pixels.shape[2] == 1:
        assert np.array_equal(got, pixels[:, :, 0].astype(got.dtype))
    elif pixels.shape[2] == 2:
        assert np.array_equal(got, pixels[:, :, int(msg.encoding in ('uyvy', 'yuv422'))])      # the luminance
    else:
        weights = np.array([0.299, 0.587, 0.114])[::1 if msg.encoding.startswith('rgb') else -1]      # ITU-R BT.601
        assert np.abs(got - pixels[:, :, :3] @ weights).max() <= 1


@examples(2)
@given(st.sampled_from(['.png', '.jpg']), st.sampled_from([np.uint8, np.uint16]), st.integers(1, 9), st.data())
def test_a_compressed_image_that_was_damaged_is_an_image_or_refused(suffix, dtype, size, data):
    pixels = np.arange(size * 8, dtype=np.uint8).reshape(size, 8).astype(dtype if suffix == '.png' else np.uint8)
    raw = bytearray(cv2.imencode(suffix, pixels)[1].tobytes())
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(raw) - 1), st.integers(0, 255)), max_size=4)):
        raw[place] = value
    raw = raw[:data.draw(st.integers(0, len(raw)))] + data.draw(st.binary(max_size=4))
    try:
        got = compressed_to_array(SimpleNamespace(format='png', data=bytes(raw)))
    except BadImage as error:
        assert str(error)
    else:
        assert got.ndim == 2 and got.size and got.dtype in (np.uint8, np.uint16, np.float32)


# ---- camera infos

K = np.array([[800.0, 0, 31.5], [0, 800.0, 31.5], [0, 0, 1]])


def projection(angle, distance=0.8):
    """(3, 4) P of a source at `distance` from the origin that looks at it horizontally, image 64 x 64."""
    forward = np.array([np.sin(angle), np.cos(angle), 0.0])
    right = np.cross(forward, [0, 0, 1.0])
    return K @ np.c_[np.stack([right, np.cross(forward, right), forward]), [0, 0, distance]]


def info(**fields):
    values = dict(header=SimpleNamespace(frame_id='plane'), height=64, width=64, distortion_model='plumb_bob',
                  d=[0.0] * 5, k=K.ravel().tolist(),
                  r=np.eye(3).ravel().tolist(), p=projection(0.0).ravel().tolist(), binning_x=0, binning_y=0,
                  roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0))
    return SimpleNamespace(**values | fields)


@st.composite
def camera_infos(draw, P=None):
    """CameraInfo of a 64 x 64 image in which a few things are absurd."""
    msg = info() if P is None else info(p=P.ravel().tolist())
    for name, size in draw(st.lists(st.sampled_from([('k', 9), ('p', 12), ('r', 9), ('d', 5)]), max_size=2)):
        values = list(getattr(msg, name))
        for place in draw(st.lists(st.integers(0, size - 1), max_size=3)):
            values[place] = draw(st.one_of(ANY, st.just(values[place] * draw(st.floats(-3, 3)))))
        setattr(msg, name, values)
    if draw(st.booleans()):
        msg.distortion_model = draw(st.sampled_from(['', 'plumb_bob', 'rational_polynomial', 'equidistant', 'fisheye']))
        msg.d = draw(st.lists(ANY | st.floats(-1, 1), max_size=15))
    for name in draw(st.lists(st.sampled_from(['width', 'height', 'binning_x', 'binning_y']), max_size=1)):
        setattr(msg, name, draw(UINT32))
    for name in draw(st.lists(st.sampled_from(['x_offset', 'y_offset', 'width', 'height']), max_size=1)):
        setattr(msg.roi, name, draw(UINT32))
    return msg


@examples(5)
@given(camera_infos(), st.booleans())
def test_a_camera_info_is_a_camera_or_refused(msg, rectified):
    try:
        checked_camera(msg, Config.from_values(rectified=rectified))
        view = camera_info_to_view(msg, 'a', (64, 64), rectified=rectified)
    except BadCameraInfo as error:
        assert str(error)
        return
    assert (np.isfinite(view.P).all() and np.isclose(np.linalg.norm(view.P[2, :3]), 1.0)
            and (view.width, view.height) == (64, 64))
    assert camera(msg) == camera(msg) and hash(camera(msg)) == hash(camera(msg))


LINE = cv2.GaussianBlur(cv2.line(np.full((64, 64), 180, np.uint8), (31, 0), (33, 40), 60, 2), (3, 3), 0)
GREYS = st.one_of(
    st.just(LINE), st.just((LINE * 257.0).astype(np.uint16)), st.just(-LINE.astype(np.float32)),
    st.just(LINE.astype(np.float32) * np.float32(1e36)),
    st.floats(width=32, allow_nan=False,
              allow_infinity=False).map(lambda v: np.where(LINE < 150, v, 1).astype(np.float32)),
    st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).integers(0, 256, (64, 64), np.uint8)))


@examples(2)
# its source lies where the planes look
@example(info(), info(p=projection(np.pi / 2, 0.0).ravel().tolist()), LINE, LINE, 'paper', 'dark')
@given(camera_infos(), camera_infos(projection(np.pi / 2)), GREYS, GREYS, st.sampled_from(['spline', 'paper']),
       st.sampled_from(['dark', 'bright', 'auto']))
def test_a_pair_that_is_accepted_is_answered(info_a, info_b, image_a, image_b, method, polarity):
    """No arithmetic on absurd but acceptable cameras and pixels ends in anything but an outcome."""
    try:
        views = tuple(camera_info_to_view(m, p, i.shape) for m, p, i in zip((info_a, info_b), 'ab', (image_a, image_b)))
    except BadCameraInfo:
        return
    config = Config.from_values(method=method, polarity=polarity, min_length_px=10.0)
    result = reconstruct(Frame(1, 'cell', (image_a, image_b), views), config)
    assert isinstance(result.outcome, Outcome) and (result.shape is None or np.isfinite(result.shape.points).all())


@examples()
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1),
       st.sampled_from([np.uint8, np.uint16, np.float32]))
def test_an_image_of_any_size_is_answered(height, width, seed, dtype):
    image = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(dtype)
    views = tuple(camera_info_to_view(info(height=height, width=width, p=projection(a).ravel()), p, image.shape)
                  for p, a in zip('ab', (0, np.pi / 2)))
    assert isinstance(reconstruct(Frame(1, 'cell', (image, image), views), Config()).outcome, Outcome)


@examples()
@given(st.floats(0, np.pi), st.floats(-1e-4, 1e-4), st.sampled_from([0.0, 1e-6]))
def test_planes_that_coincide_are_named(angle, turn, shift):
    views = [camera_info_to_view(info(p=(projection(a) + shift).ravel()), p, (64, 64))
             for p, a in zip('ab', (angle, angle + turn))]
    with pytest.raises(GeometryError, match='coincide|parallel'):
        check_pair(views)


# ---- predictions

@examples(2)
@given(st.lists(st.tuples(ANY, ANY, ANY), max_size=6))
def test_a_path_is_points_or_refused(positions):
    poses = [SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z))) for x, y, z in positions]
    try:
        points = path_to_points(SimpleNamespace(poses=poses))
    except BadPath:
        assert len(poses) < 2 or not np.isfinite(positions).all()
    else:
        assert np.array_equal(points, positions) and np.isfinite(points).all()
