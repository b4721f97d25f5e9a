"""Bags of drawn pairs, and what a replay made of them: what test_replay.py stands on."""

import cv2
from drawing import CALIBRATIONS

from fluoro_shape_ros.files import replay
from msg_adapters.bags import create_bag, open_bag
from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import stamp_ns

SECOND = 10**9
IMAGE, INFO = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'
SKEW = 2_000_000        # of plane B's stamps, ns
RADIUS = 'robot_radius=0.001'   # of what is drawn


def record(path, pairs, storage='mcap', *, stamps=None, infos=True, spoil=lambda message: None, compressed=False):
    """A bag of `pairs` of images, one every 0.1 s from 5 s on, logged 1 ms after their stamps."""
    stamps = [5 * SECOND + k * SECOND // 10 for k in range(len(pairs))] if stamps is None else stamps
    suffix, kind = ('/compressed', 'sensor_msgs/msg/CompressedImage') if compressed else ('', IMAGE)
    with create_bag(path, storage) as bag:
        for p in 'ab':
            bag.declare(f'/plane_{p}/image_raw{suffix}', kind)
            bag.declare(f'/plane_{p}/camera_info', INFO)
        for k, (stamp, pair) in enumerate(zip(stamps, pairs)):
            for p, pixels, calibration, skew in zip('ab', pair, CALIBRATIONS, (0, SKEW)):
                log = 5 * SECOND + k * SECOND // 10 + 1_000_000
                message = array_to_image(pixels, stamp + skew, f'plane_{p}_optical', bag.new)
                spoil(message)
                if compressed:
                    message = bag.new(kind, header=message.header, format='png', data=cv2.imencode('.png', pixels)[1])
                if infos:
                    bag.write(f'/plane_{p}/camera_info',
                              calibration_to_camera_info(calibration, stamp + skew, f'plane_{p}_optical', bag.new), log)
                bag.write(f'/plane_{p}/image_raw{suffix}', message, log)
    return path


def read(path):
    with open_bag(path) as bag:
        return {topic: [(r.log_ns, r.message) for r in bag.messages([topic])] for topic in bag.types()}


def outcomes(path):
    """Outcome of every pair by its stamp, from the diagnostics."""
    return {stamp_ns(m): {v.key: v.value for v in m.status[0].values}['last outcome']
            for _, m in read(path)['/diagnostics']}


def main(*arguments):
    return replay.main(['-p', RADIUS, *map(str, arguments)])
