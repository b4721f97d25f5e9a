"""Making messages: the same call for both libraries, defaults filled in, arrays of any shape and byte order."""

import subprocess
import sys

import numpy as np
import pytest

from msg_adapters.messages import header, ros_message, stamp_ns


def test_header_and_stamp(new):
    h = header(new, 5_000_000_007, 'cell')
    assert (h.stamp.sec, h.stamp.nanosec, h.frame_id) == (5, 7, 'cell')
    assert stamp_ns(h) == stamp_ns(new('geometry_msgs/msg/PointStamped', header=h)) == 5_000_000_007


def test_fields_that_are_not_given_have_their_default(new):
    msg = new('sensor_msgs/msg/CameraInfo')
    assert ((msg.width, msg.distortion_model, list(msg.d), list(msg.k), msg.roi.do_rectify, stamp_ns(msg))
            == (0, '', [], [0.0] * 9, False, 0))
    assert new('nav_msgs/msg/Path').poses == []


@pytest.mark.parametrize('dtype', [float, np.float32, '>f8', int])
def test_arrays_of_any_type_and_shape(new, dtype):
    given = np.arange(12).reshape(3, 4).astype(dtype)
    msg = new('sensor_msgs/msg/CameraInfo', p=given, k=given[:, :3], d=given[0, ::2])
    assert list(msg.p) == list(range(12))
    assert list(msg.k) == [0, 1, 2, 4, 5, 6, 8, 9, 10]
    assert list(msg.d) == [0, 2]


def test_an_empty_array(new):
    assert len(new('sensor_msgs/msg/Image', data=np.zeros(0, np.uint8)).data) == 0


def test_a_byte_may_be_a_number(new):
    level = new('diagnostic_msgs/msg/DiagnosticStatus', level=2).level
    assert level in (2, b'\x02')


def test_an_unknown_field_is_an_error(new):
    with pytest.raises((TypeError, KeyError), match='colour'):
        new('sensor_msgs/msg/Image', colour='red')


def test_ros_accepts_what_it_is_given():
    """rclpy checks nothing when it makes a message; publishing would: its serialisation takes what the factory
    makes."""
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message, serialize_message
    msg = ros_message('sensor_msgs/msg/Image', data=np.arange(200, dtype=np.uint8).reshape(10, 20), height=10, width=20,
                      encoding='mono8', step=20)
    again = deserialize_message(serialize_message(msg), type(msg))
    assert again == msg and list(again.data) == list(range(200))
    info = ros_message('sensor_msgs/msg/CameraInfo', k=np.eye(3), p=np.eye(3, 4), d=np.arange(4))
    assert list(deserialize_message(serialize_message(info), type(info)).d) == [0, 1, 2, 3]


def test_the_adapters_need_no_ros():
    code = ('import sys\nfor name in ("rclpy", "sensor_msgs", "std_msgs"): sys.modules[name] = None\n'
            'import msg_adapters.images, msg_adapters.cameras, msg_adapters.shapes, msg_adapters.calibration, '
            'msg_adapters.messages\n')
    subprocess.run([sys.executable, '-c', code], check=True, timeout=60)
