"""What one untrusted publisher can do: the node's memory and time stay bounded, it names what it refuses, and the next
good pair works."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.node import NodeNameNonExistentError
from rclpy.serialization import serialize_message
from ros_client import BASE, GOOD, VIEWS, image_msg, info_msg

from fluoro_shape_ros.bench.process_usage import usage
from fluoro_shape_ros.resources import resource_path

LIMIT = 60.0        # s, for whatever must happen: the machine may be busy
MOST_MB = 2000      # of resident memory, ever: some of the largest images that may come, being received
# subscribed only when a parameter says so
OPTIONAL = {'/plane_a/image_raw/compressed', '/plane_b/image_raw/compressed', '/tf', '/tf_static', '/clock'}


@pytest.fixture(scope='module')
def stream(tmp_path_factory):
    with ros.answered(tmp_path_factory, BASE, ros.RADIUS) as (node, client):
        yield client
        assert usage(node.process.pid).peak / 1e6 < MOST_MB      # with the process that reconstructs


@pytest.fixture
def client(stream):
    yield stream
    stream.send_pixels(GOOD)
    assert stream.answer(stream.send_pixels(GOOD), LIMIT)


def says(client, *words):
    del client.statuses[:]
    return client.until(lambda: any(all(w in s.message for w in words) for s in client.statuses), LIMIT)


def test_the_policy_names_what_the_node_has_and_nothing_else(client):
    names = {}
    for kind, right in (('topics', 'subscribe'), ('topics', 'publish'), ('services', 'reply')):
        profile = ET.parse(resource_path('sros2_policy.xml')).find(
            'enclaves/enclave[@path="/fluoro_shape"]/profiles/profile[@node="fluoro_shape"]')
        assert profile.get('ns') == '/'
        listed = [entry.text for block in profile.findall(kind) if block.get(right) == 'ALLOW' for entry in block]
        assert len(listed) == len(set(listed))
        names[right] = {client.node.resolve_topic_name(n) if n[0] != '~' else f'/fluoro_shape{n[1:]}' for n in listed}
    graph = client.node

    def has(listing):
        try:
            return {name for name, _ in listing('fluoro_shape', '/')}
        except NodeNameNonExistentError:        # its topics are discovered, its name not yet
            return None
    assert client.until(lambda: has(graph.get_publisher_names_and_types_by_node) == names['publish'], LIMIT)
    assert client.until(lambda: has(graph.get_subscriber_names_and_types_by_node) == names['subscribe'] - OPTIONAL,
                        LIMIT)
    # nodes describe their types only where ROS is new enough
    described = {'/fluoro_shape/get_type_description'}
    assert client.until(lambda: (has(graph.get_service_names_and_types_by_node) or set()) | described == names['reply'],
                        LIMIT)


@pytest.mark.parametrize('size', [46341, 2**32 - 1], ids=['2 GB', 'absurd'])
def test_a_header_that_promises_a_huge_image(client, size):
    client.send([image_msg(GOOD[0], height=size, width=size, step=size), image_msg(GOOD[1])])
    assert says(client, 'bad_image', f'{size}x{size} pixels')


def test_a_huge_image(client):
    """10,000 x 10,000, 100 MB: refused before anything is computed from it."""
    big = image_msg(np.zeros((10_000, 10_000), np.uint8))
    client.send([big, image_msg(GOOD[1])], infos=[info_msg(VIEWS[0], 10_000), info_msg(VIEWS[1])])
    assert says(client, 'bad_image', '10000x10000 pixels')


def test_a_thousand_images_at_once(client):
    """One plane is flooded; the stamps run ahead of the other plane's."""
    small = image_msg(GOOD[0][:8, :8])
    for k in range(1000):
        small.header.stamp = ros.time_msg(client.now_ns + k * 1000)
        client.images[0].publish(small)
    client.now_ns += ros.STEP_NS


def test_a_thousand_camera_infos_at_once(client):
    for k in range(1000):
        info = info_msg(ros.projection(k / 10))
        info.header.stamp = ros.time_msg(client.now_ns + k * 1000)
        client.infos[0].publish(info)
    client.now_ns += ros.STEP_NS


def test_a_prediction_of_a_million_poses(client):
    pose = bytes(serialize_message(Path(poses=[PoseStamped()] * 2)))[-72:]      # all are alike
    one = bytearray(serialize_message(Path(poses=[PoseStamped()])))
    count = one.index((1).to_bytes(4, 'little'), 12)
    one[count:count + 4] = (1_000_000).to_bytes(4, 'little')
    client.prediction.publish(bytes(one) + pose * 999_999)
    assert says(client, 'predicted_backbone', 'a Path of 72000')


@pytest.mark.parametrize('fields, words', [
    (dict(d=[0.0] * 100_000), 'D has 100000 coefficients'),
    (dict(distortion_model='x' * 100_000), 'distortion model "xxx'),
])
def test_camera_infos_without_end(client, fields, words):
    client.send_pixels(GOOD, infos=[info_msg(VIEWS[0], **fields), info_msg(VIEWS[1])])
    assert says(client, 'camera info refused', words)
    assert max(len(s.message) for s in client.statuses) < 1000


def test_names_without_end(client):
    info = info_msg(VIEWS[0])
    info.header.stamp, info.header.frame_id = ros.time_msg(client.now_ns + ros.STEP_NS), 'x' * 100_000
    client.infos[0].publish(info)
    client.send([image_msg(GOOD[0], encoding='y' * 100_000), image_msg(GOOD[1])])
    assert says(client, 'bad_image', 'encoding "yyy')
    assert max(len(s.message) for s in client.statuses) < 1000


def test_bytes_that_are_no_message(client):
    """What the middleware can't read it drops, but predictions are read by the node itself."""
    for publisher, message in ((client.images[0], image_msg(GOOD[0])), (client.infos[1], info_msg(VIEWS[1])),
                               (client.prediction, Path(poses=[PoseStamped()] * 3))):
        data = bytes(serialize_message(message))
        for damaged in (data[:9], data[:len(data) // 2], data[:4] + b'\xff' * (len(data) - 4)):
            publisher.publish(damaged)
    assert says(client, 'predicted_backbone', 'damaged')
