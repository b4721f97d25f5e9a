"""docs/connect.md: what is typed where there is no `ros2` command works as it stands there."""

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('rosbags')

import ros_client as ros

from msg_adapters.bags import open_bag

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / 'docs' / 'connect.md').read_text(encoding='utf-8')
ENVIRONMENT = {**os.environ, 'ROS_DOMAIN_ID': str(ros.OTHER),
               'PYTHONPATH': os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))}


def block(name):
    return re.search(rf'<!-- {name} -->\n```\w+\n(.*?)```', PAGE, re.DOTALL)[1]


def start(arguments, folder):
    return subprocess.Popen([sys.executable, *arguments], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True)


@pytest.fixture
def answered(tmp_path):
    with (ros.NodeProcess(tmp_path / 'log.txt', 'reference_frame:=cell', domain=ros.OTHER) as node,
          ros.Client(domain=ros.OTHER) as client):
        assert client.connected(), node.log
        yield client


def said(client, line, folder):
    """What a line prints while images come."""
    program, *arguments = shlex.split(line)
    assert program == 'python'
    with start(arguments, folder) as process:
        try:
            assert any(client.send([ros.image_msg(pixels[:64, :64]) for pixels in ros.BLANK])
                       and client.until(lambda: process.poll() is not None, 0.1) for _ in range(600)), line
            out, errors = process.communicate()
        finally:
            process.kill()
    assert process.returncode == 0, errors
    return out


@pytest.mark.parametrize('name, words', [
    ('list', ["('/plane_a/image_raw', ['sensor_msgs/msg/Image'])"]),
    ('echo', ['distortion_model=', "frame_id='plane_a_optical'", '/fluoro_shape: plane a: ']),
    ('call', ['success=True', 'successful=True']),
])
def test_lines(answered, tmp_path, name, words):
    lines = block(name).splitlines()
    assert len(lines) == len(words)
    for line, word in zip(lines, words):
        assert word in said(answered, line, tmp_path), line


def test_a_recording(answered, tmp_path):
    (tmp_path / 'record.py').write_text(block('record'))
    with start(['record.py'], tmp_path) as process:
        try:
            hearing = lambda: all(p.get_subscription_count() == 2    # noqa: E731
                                  for p in (*answered.images, *answered.infos))
            assert answered.until(hearing)
            stored = lambda: ((tmp_path / 'case1').exists()    # noqa: E731
                              and sum(f.stat().st_size for f in (tmp_path / 'case1').iterdir()) > 100_000)
            assert any(answered.send_pixels(ros.BLANK) and answered.until(stored, 0.05) for _ in range(400))
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    with open_bag(tmp_path / 'case1') as bag:
        topics = {f'/plane_{p}/{name}' for p in 'ab' for name in ('image_raw', 'camera_info')}
        assert topics == set(bag.types()) and {r.topic for r in bag.messages(topics)} == topics and bag.damage == ''
