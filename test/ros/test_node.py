"""The node on real topics."""

import importlib.util

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Path
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from ros_client import BASE, BLANK, GOOD, SIZE, VIEWS, Client, image_msg, info_msg, points
from std_srvs.srv import SetBool

TOLERANCE = 0.0025      # m: an image pixel is 1 mm, the line is drawn on whole pixels
PARAMETERS = ('reference_frame:=cell', 'mask_frames:=2', BASE, ros.RADIUS)


@pytest.fixture(scope='module')
def stream(tmp_path_factory):
    """One client for all; where it stops, the next test goes on."""
    with ros.answered(tmp_path_factory, *PARAMETERS) as (_, client):
        assert client.good()    # by now none of the first ones is under way
        yield client


@pytest.fixture
def client(stream):
    yield stream
    assert stream.good()        # whatever a test did, the next good pair works


def test_good_pair(client):
    stamp = client.send_pixels(GOOD)
    path, tip = client.answer(stamp)
    X = points(path)
    assert path.header.frame_id == tip.header.frame_id == path.poses[0].header.frame_id == 'cell'
    assert path.header.stamp == tip.header.stamp == ros.time_msg(stamp)
    assert np.array_equal(X[-1], [tip.point.x, tip.point.y, tip.point.z])
    assert np.linalg.norm(X[[0, -1]] - ros.curve()[[0, -1]], axis=1).max() < TOLERANCE
    assert np.linalg.norm(X[:, None] - ros.curve(), axis=2).min(axis=1).max() < TOLERANCE
    steps = np.linalg.norm(np.diff(X, axis=0), axis=1)
    assert np.allclose(steps[:-1], 0.001, atol=2e-5)
    q = np.array([[p.pose.orientation.x, p.pose.orientation.y, p.pose.orientation.z, p.pose.orientation.w]
                  for p in path.poses])
    x, y, z, w = q.T
    x_axis = np.c_[1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    tangent = np.gradient(X, axis=0)
    assert ((x_axis * tangent).sum(axis=1) / np.linalg.norm(tangent, axis=1)).min() > 0.98


def test_small_skew_pairs_and_the_stamp_is_that_of_plane_a(client):
    assert client.answer(client.send_pixels(GOOD, skew_ns=5_000_000))


def test_blank_pair_publishes_nothing(client):
    stamp = client.send_pixels(BLANK)
    assert client.hears('no_device_in_plane_a')
    assert client.good() and stamp not in client.paths and stamp not in client.tips


def test_stamps_too_far_apart_do_not_pair(client):
    stamp = client.send_pixels(GOOD, skew_ns=30_000_000)
    client.now_ns += ros.STEP_NS
    assert client.good() and stamp not in client.paths
    assert int(client.value('pairing', 'unpaired')) >= 2


@pytest.mark.parametrize('bad, words', [
    (dict(encoding='yuv422'), ('plane b', 'yuv422')),
    (dict(step=SIZE - 1), ('plane b', f'step {SIZE - 1}')),
    (dict(data=ros.bytes_of(bytes(100))), ('plane b', '100 bytes')),
    (dict(height=0), ('plane b', 'empty')),
])
def test_a_bad_image_is_named(client, bad, words):
    stamp = client.send([image_msg(GOOD[0]), image_msg(GOOD[1], **bad)])
    assert client.hears('bad_image', *words)
    assert client.good() and stamp not in client.paths


def test_an_image_that_contradicts_its_camera_info_is_named(client):
    stamp = client.send_pixels([pixels[:100, :100] for pixels in GOOD])
    assert client.hears('bad_camera_info', '320x320', '100x100')
    assert client.good() and stamp not in client.paths


def test_a_bad_camera_info_is_named_and_the_one_before_holds(client):
    stamp = client.send_pixels(GOOD, infos=[info_msg(VIEWS[0], p=[0.0] * 12), info_msg(VIEWS[1])])
    assert client.hears('camera info refused', 'plane a: P is zero')
    assert client.answer(stamp)


def test_parallel_planes_are_named(client):
    stamp = client.send_pixels(GOOD, infos=[info_msg(VIEWS[0]), info_msg(VIEWS[0])])
    assert client.hears('bad_geometry', 'coincide')
    assert client.good() and stamp not in client.paths


def test_a_moving_plane_uses_the_camera_that_comes_after_its_image(client):
    for angle in (20, 40):
        views = [ros.projection(angle), ros.projection(angle + 90)]
        stamp = client.send_pixels([ros.draw(P) for P in views], infos=[info_msg(P) for P in views], infos_last=True)
        path, _ = client.answer(stamp)
        assert np.linalg.norm(points(path)[[0, -1]] - ros.curve()[[0, -1]], axis=1).max() < TOLERANCE


def test_too_many_pairs_are_dropped_not_queued(client):
    assert client.answer(client.send_pixels(GOOD))      # what an impatient client sent before is done with, too
    dropped = int(client.value('pairing', 'dropped'))
    client.paths.clear()
    stamps = [client.send_pixels(GOOD) for _ in range(5)]
    assert client.answer(stamps[-1])
    client.until(lambda: len(client.paths) + int(client.value('pairing', 'dropped')) - dropped == 5)
    assert (set(client.paths) <= set(stamps)
            and len(client.paths) + int(client.value('pairing', 'dropped')) - dropped == 5)


def test_after_stamps_jump_back_the_second_pair_works(client):
    client.now_ns -= 30 * 10**9
    client.send_pixels(GOOD)
    assert client.answer(client.send_pixels(GOOD))
    assert client.hears('jumped back')


def test_reset(client):
    reply = client.trigger('reset')
    assert reply.success and reply.message
    assert client.answer(client.send_pixels(GOOD))


def test_pause_and_resume(client):
    assert client.call(SetBool, '/fluoro_shape/enable', SetBool.Request(data=False)).success
    stamp = client.send_pixels(GOOD)
    assert client.hears('paused')
    assert client.call(SetBool, '/fluoro_shape/enable', SetBool.Request(data=True)).success
    assert client.answer(client.send_pixels(GOOD)) and stamp not in client.paths


@pytest.mark.parametrize('name, value, reason', [
    ('robot_radius', -1.0, 'robot_radius'),
    ('polarity', 'grey', 'polarity: must be one of dark, bright, auto'),
    ('expected_length', [0.2, 0.1], 'needs 0 <= min < max'),
    ('base_position', [0.0], 'base_position: needs 0 or 3 numbers'),
    ('time_budget', -0.1, 'time_budget'),
])
def test_a_value_that_cannot_work_is_refused_and_the_old_one_stays(client, name, value, reason):
    get = lambda: client.call(GetParameters, '/fluoro_shape/get_parameters',    # noqa: E731
                              GetParameters.Request(names=[name])).values
    before = get()
    result = client.set(name, value)
    assert not result.successful and reason in result.reason
    assert get() == before


def test_parameters_take_effect_at_run_time(client):
    assert client.set('sync_slop', 0.05).successful
    assert client.answer(client.send_pixels(GOOD, skew_ns=30_000_000))
    assert client.set('sync_slop', 0.01).successful
    client.now_ns += ros.STEP_NS
    assert client.set('backbone_spacing', 0.005).successful and client.set('reference_frame', '').successful
    path, _ = client.answer(client.send_pixels(GOOD))
    assert path.header.frame_id == 'plane_a_optical'
    assert np.allclose(np.linalg.norm(np.diff(points(path), axis=0), axis=1)[:-1], 0.005, atol=1e-4)
    assert client.set('backbone_spacing', 0.001).successful and client.set('reference_frame', 'cell').successful


def test_what_is_not_found_in_time_is_named_and_counted(client):
    # so that there is nothing to track
    assert client.set('time_budget', 1e-6).successful and client.trigger('reset').success
    stamp = client.send_pixels(GOOD)
    assert client.hears('out_of_time: no curve was found by then') and stamp not in client.paths
    assert (int(client.value('reconstruction', 'count out_of_time')) >= 1
            and 0 < int(client.value('reconstruction', 'out of time (%)')) <= 100)
    assert client.set('time_budget', 0).successful      # no limit
    assert client.answer(client.send_pixels(GOOD))


def test_reliability_can_be_chosen(client):
    assert client.set('image_reliability', 'best_effort').successful and client.connected()
    assert client.value('plane b', 'reliability') == 'best_effort'
    assert client.good()
    assert client.set('image_reliability', 'auto').successful and client.connected()
    assert client.value('plane b', 'reliability') == 'reliable'


def test_whole_numbers_and_empty_lists_are_taken(client):
    assert client.set('max_curvature', 5000).successful
    assert client.set('expected_length', [0, 1]).successful
    assert client.set('expected_length', [], Parameter.Type.BOOL_ARRAY).successful
    assert client.set('max_curvature', 0.0).successful


def test_the_tip_is_the_end_away_from_the_base(client):
    assert client.set('base_position', ros.curve()[-1].tolist()).successful
    path, _ = client.answer(client.send_pixels(GOOD))
    assert np.linalg.norm(points(path)[-1] - ros.curve()[0]) < TOLERANCE
    assert client.set('base_position', ros.curve()[0].tolist()).successful


def test_mask_capture(client):
    assert client.trigger('capture_mask').success
    first = client.send_pixels(GOOD)
    assert client.until(lambda: client.value('reconstruction', 'mask') == 'capturing, 1 of 2 pairs')
    second = client.send_pixels(GOOD)
    assert client.until(lambda: client.value('reconstruction', 'mask') == 'in use, mean of 2 pairs')
    assert first not in client.paths and second not in client.paths
    small = [ros.projection(0, 200), ros.projection(90, 200)]
    client.send_pixels([ros.draw(P, 200) for P in small], infos=[info_msg(P, 200) for P in small])
    assert client.hears('mask cleared')
    assert client.value('reconstruction', 'mask') == 'none'
    assert client.trigger('clear_mask').success


def test_a_prediction_is_used_and_a_bad_or_stale_one_named(client):
    client.prediction.publish(Path(poses=[PoseStamped()]))
    assert client.hears('predicted_backbone', '1 poses')
    good = Path(poses=[PoseStamped(pose=Pose(position=Point(x=x, y=y, z=z))) for x, y, z in ros.curve()[::20].tolist()])
    good.header.stamp = ros.time_msg(client.now_ns + ros.STEP_NS)
    client.prediction.publish(good)
    fate = lambda: client.value('reconstruction', 'prediction')     # noqa: E731
    assert client.until(lambda: client.answer(client.send_pixels(GOOD)) and fate() == 'agrees')
    client.now_ns += 10**9
    assert client.answer(client.send_pixels(GOOD)) and client.hears('prediction_ignored', 'older than the pair')
    assert client.trigger('reset').success      # forgets it
    assert client.good() and fate() == ''


def test_16_bits_in_either_byte_order(client):
    for big in (0, 1):
        # 12 bits: the low byte alone says nothing
        pair = [(pixels.astype(np.uint16) * 16).astype('>u2' if big else '<u2') for pixels in GOOD]
        stamp = client.send([image_msg(pixels, encoding='mono16', is_bigendian=big, step=2 * SIZE) for pixels in pair])
        path, _ = client.answer(stamp)
        assert np.linalg.norm(points(path)[[0, -1]] - ros.curve()[[0, -1]], axis=1).max() < TOLERANCE


def test_distortion_is_removed_unless_the_images_are_rectified(client):
    """The image as received is some 8 px off P's, and bent; K and D tell."""
    K, D = ros.intrinsics() + [[0, 0, 8], [0, 0, -6], [0, 0, 0]], np.array([-4.0, 0, 0.01, -0.01, 0])
    infos, pair = [], []
    for angle in (0, 90):
        R, t = ros.pose(angle)
        px = cv2.projectPoints(ros.curve(), cv2.Rodrigues(R)[0], t, K, D)[0][:, 0]
        # as if a camera without distortion saw that
        bent = np.c_[px, np.ones(len(px))] @ np.linalg.inv(K).T * (ros.curve() @ R[2] + t[2])[:, None]
        infos.append(info_msg(ros.projection(angle), k=K.ravel(), d=D))
        pair.append(ros.draw(K @ np.eye(3, 4), points=bent))

    def error():
        path, _ = client.answer(client.send_pixels(pair, infos=infos))
        return np.linalg.norm(points(path)[[0, -1]] - ros.curve()[[0, -1]], axis=1).max()
    # where the machine is slow, the first pair may have come before its camera
    assert min(error() for _ in range(2)) < TOLERANCE
    assert client.set('rectified', True).successful
    assert error() > 0.005
    assert client.set('rectified', False).successful


def jpeg_msg(pixels):
    return ros.CompressedImage(format='mono8; jpeg compressed ',
                               data=ros.bytes_of(cv2.imencode('.jpg', pixels)[1].tobytes()))


def test_compressed_images(client):
    assert client.set('image_transport', 'compressed').successful
    with Client(compressed=True, start_ns=client.now_ns) as other:
        assert other.connected() and other.good()
        assert other.answer(other.send([jpeg_msg(pixels) for pixels in GOOD]))
        assert other.answer(other.send([ros.png_msg(pixels.astype(np.uint16) * 16) for pixels in GOOD]))
        other.send([ros.png_msg(GOOD[0]), ros.CompressedImage(format='png', data=[1, 2, 3])])
        assert other.hears('bad_image', 'plane b')
        client.now_ns = other.now_ns
    assert client.set('image_transport', 'raw').successful
    assert client.connected()


@pytest.mark.skipif(importlib.util.find_spec('tf2_ros') is None, reason='tf2_ros is not installed')
def test_a_pose_that_tf_does_not_know_is_named(client):
    assert client.set('geometry', 'tf').successful
    stamp = client.send_pixels(GOOD)
    assert client.hears('no_transform')
    assert client.set('geometry', 'camera_info').successful
    assert client.connected() and client.good() and stamp not in client.paths


@pytest.mark.skipif(importlib.util.find_spec('tf2_ros') is not None, reason='tf2_ros is installed')
def test_tf_is_refused_where_it_is_not_installed(client):
    result = client.set('geometry', 'tf')
    assert not result.successful and 'needs tf2_ros, which is not installed' in result.reason


def test_a_best_effort_publisher_is_heard(stream):
    """Beside the reliable one; diagnostics say so, and with best-effort gone it is heard reliably again."""
    with Client(ReliabilityPolicy.BEST_EFFORT, start_ns=stream.now_ns) as client:
        assert client.connected() and client.good()
        assert client.hears('best-effort')
        assert client.value('plane a', 'reliability') == 'best_effort'
        stream.now_ns = client.now_ns
    assert stream.good()
