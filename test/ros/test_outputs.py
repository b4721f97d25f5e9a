"""What the node publishes only while somebody listens, on real topics."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from geometry_msgs.msg import PoseWithCovarianceStamped
from ros_client import BASE, BLANK, GOOD, SIZE, VIEWS, Client, NodeProcess, image_msg, points
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.ros.outputs import Outputs
from fluoro_shape_ros.ros.worker import Job
from msg_adapters.messages import stamp_ns

TOLERANCE = 0.0025      # m: an image pixel is 1 mm
ON_DEMAND = {'tip_pose': PoseWithCovarianceStamped, 'backbone_points': PointCloud2, 'markers': MarkerArray,
             'plane_a/overlay': Image, 'plane_b/overlay': Image}


@pytest.fixture(scope='module')
def client(tmp_path_factory):
    with ros.answered(tmp_path_factory, 'reference_frame:=cell', BASE, ros.RADIUS) as (_, client):
        yield client


@pytest.fixture(scope='module')
def heard(client):
    """What comes, by topic and stamp."""
    with client.listening(ON_DEMAND) as heard:
        assert client.insist(lambda: all(heard.values()), every=1.0)
        assert client.good()    # by now none of the first ones is under way
        yield heard


def heard_all(client, heard, stamp, topics=ON_DEMAND):
    assert client.until(lambda: all(stamp in heard[topic] for topic in topics)), {t: sorted(m)[-3:]
                                                                                  for t, m in heard.items()}
    return [heard[topic][stamp] for topic in topics]


def test_outputs_on_demand(client, heard):
    stamp = client.send_pixels(GOOD, skew_ns=5_000_000)
    path, tip = client.answer(stamp)
    pose, cloud, markers, *overlays = heard_all(client, heard, stamp)
    assert {m.header.frame_id for m in (pose, cloud, *overlays, *markers.markers)} == {'cell'}
    assert {stamp_ns(m) for m in (*overlays, *markers.markers)} == {stamp}
    assert pose.pose.pose == path.poses[-1].pose
    variance = np.diag(pose.pose.covariance.reshape(6, 6))[:3]
    assert (variance > 0).all() and np.sqrt(variance.max()) < TOLERANCE
    assert cloud.width == len(path.poses) and [cloud.fields[k].name for k in (4, -1)] == ['sigma', 'confidence']
    confidence = np.frombuffer(cloud.data, '<f4').reshape(cloud.width, -1)[:, -1]
    assert len(np.unique(confidence)) == 1 and not (np.abs(confidence - 0.5) > 0.5).any()   # NaN while it is not known
    tube = next(m for m in markers.markers if m.ns == 'tube')
    corners = np.array([[p.x, p.y, p.z] for p in tube.points])
    # robot_radius
    assert np.allclose(np.linalg.norm(corners[:, None] - points(path), axis=2).min(axis=1), 0.001, rtol=0.01)
    for picture, P in zip(overlays, VIEWS):
        assert (picture.encoding, picture.height, picture.width, picture.step) == ('bgr8', SIZE, SIZE, 3 * SIZE)
        u, v, w = P @ [*points(path)[len(path.poses) // 2], 1]
        pixels = np.frombuffer(picture.data, np.uint8).reshape(SIZE, SIZE, 3)
        near = pixels[round(v / w) - 1:round(v / w) + 2, round(u / w) - 1:round(u / w) + 2]
        # the image is grey; a coloured line, blended at its edges, is drawn there
        assert np.ptp(near, axis=2).max() > 60


class Recorder:
    """Stands in for the node and its publishers, to each of which somebody listens."""

    def __init__(self):
        self.published = {}

    def create_publisher(self, kind, topic, *_, **__):
        return SimpleNamespace(publish=lambda msg: self.published.update({topic: msg}),
                               get_subscription_count=lambda: 1)


def test_the_confidence_of_a_result_is_in_every_point_and_in_words():
    x = np.linspace(0, 0.1, 5)
    shape = Shape(np.c_[x, 0 * x, 0 * x], x, np.full((5, 3, 3), np.nan), np.zeros((5, 2)))
    job = Job(5, tuple(GOOD), (None, None), Config(), 0, 0.0)
    node = Recorder()
    Outputs(node).explain(job, None, Reconstruction(Outcome.OK, 'ok', shape, confidence=0.998))
    cloud, pose, markers = (node.published[topic] for topic in ('backbone_points', 'tip_pose', 'markers'))
    assert np.frombuffer(cloud.data, '<f4').reshape(5, -1)[:, -1].tolist() == [np.float32(0.998)] * 5
    assert (stamp_ns(cloud), stamp_ns(pose)) == (5, 5)
    assert [m.text for m in markers.markers if m.ns == 'outcome'] == ['ok, confidence 0.998, 100.0 mm long']
    node = Recorder()
    Outputs(node).explain(job, None, Reconstruction(Outcome.LOW_CONFIDENCE, 'it ends at a wire', confidence=0.25))
    assert set(node.published) == {'markers', 'plane_a/overlay', 'plane_b/overlay'}


def test_a_rejected_pair_is_shown_with_its_reason_and_nothing_else(client, heard):
    stamp = client.send_pixels([GOOD[0], BLANK[1]])
    markers, *overlays = heard_all(client, heard, stamp, ['markers', 'plane_a/overlay', 'plane_b/overlay'])
    text = {m.ns: m for m in markers.markers}['outcome']
    assert text.action == text.ADD and 'no device in plane b' in text.text
    assert all(m.action == m.DELETE for m in markers.markers if m is not text)
    assert client.good() and stamp not in heard['tip_pose'] and stamp not in heard['backbone_points']


def test_a_pair_without_geometry_is_shown_as_it_came(client, heard):
    small = [pixels[:100, :100] for pixels in GOOD]
    stamp = client.send_pixels(small)
    markers, *overlays = heard_all(client, heard, stamp, ['markers', 'plane_a/overlay', 'plane_b/overlay'])
    assert all(m.action == m.DELETE for m in markers.markers)
    assert [(m.width, m.header.frame_id) for m in overlays] == [(100, 'cell')] * 2
    stamp = client.send([image_msg(GOOD[0]), image_msg(GOOD[1], encoding='yuv422')])
    heard_all(client, heard, stamp, ['plane_a/overlay'])
    assert client.good() and stamp not in heard['plane_b/overlay']


def test_what_nobody_listens_to_is_not_computed(tmp_path):
    code = """if True:
        import sys
        import fluoro_shape_ros.ros.outputs as outputs
        from fluoro_shape_ros.node import main
        for name in ('overlay', 'shape_to_markers'):
            real = getattr(outputs, name)
            setattr(outputs, name, lambda *a, real=real, name=name: print('made', name, flush=True) or real(*a))
        sys.exit(main())"""
    with (NodeProcess(tmp_path / 'log.txt', BASE, ros.RADIUS, code=code, domain=ros.OTHER) as node,
          Client(domain=ros.OTHER) as client):
        assert client.connected() and client.insist(lambda: client.paths), node.log
        assert client.good() and client.good() and 'made' not in node.log
        with client.listening({'markers': MarkerArray}) as heard:
            assert client.insist(lambda: heard['markers'])
        assert 'made shape_to_markers' in node.log and 'made overlay' not in node.log
