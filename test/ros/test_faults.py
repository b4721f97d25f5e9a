"""The fault table (docs/faults.md) on real topics: what diagnostics say, and that the second good pair afterwards gives
a good result.

All rows go through one node, one after the other; what a row leaves behind is the next one's trouble.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from ros_client import BASE, GOOD, SIZE, STEP_NS, VIEWS, Client, image_msg, info_msg, points
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

TOLERANCE = 0.0025      # m: an image pixel is 1 mm, the line is drawn on whole pixels
LIMIT = 45.0            # s, for whatever must happen: the machine may be busy
SECOND = 10**9


@pytest.fixture(scope='module')
def stream(tmp_path_factory):
    with ros.answered(tmp_path_factory, BASE, ros.RADIUS) as (_, client):
        yield client


@pytest.fixture
def client(stream):
    yield stream
    second_good_pair(stream)


def second_good_pair(client):
    """Two good pairs, and the right answer to the second."""
    client.send_pixels(GOOD)
    right(client, client.send_pixels(GOOD))


def right(client, stamp):
    """The pair of this stamp gets an answer, and that is right."""
    answer = client.answer(stamp, LIMIT)
    assert answer is not None, '\n'.join(f'{s.name}: {s.message} {[(v.key, v.value) for v in s.values]}'
                                         for s in client.statuses[-4:])
    path, tip = answer
    X = points(path)
    assert np.linalg.norm(X[[0, -1]] - ros.curve()[[0, -1]], axis=1).max() < TOLERANCE
    assert np.linalg.norm(X[:, None] - ros.curve(), axis=2).min(axis=1).max() < TOLERANCE
    assert np.array_equal(X[-1], [tip.point.x, tip.point.y, tip.point.z])


def says(client, name, *words):
    """Whether the status `name` comes to have these words."""
    found = lambda: any(s.name.endswith(name) and all(w in s.message for w in words)    # noqa: E731
                        for s in client.statuses)
    del client.statuses[:]
    return client.until(found, LIMIT)


def count(client, name, key):
    return int(client.value(name, key))


def send_one(client, plane, stamp_ns=None):
    """Publish a good image of one plane (0 or 1), with its camera info."""
    if stamp_ns is None:
        client.now_ns += STEP_NS
        stamp_ns = client.now_ns
    image, info = image_msg(GOOD[plane]), info_msg(VIEWS[plane])
    image.header.stamp, image.header.frame_id = ros.time_msg(stamp_ns), f'plane_{"ab"[plane]}_optical'
    info.header = image.header
    client.infos[plane].publish(info)
    client.images[plane].publish(image)


def test_one_plane_stops(client):
    newest = lambda: {s.name.split(': ')[1]: s.message for s in client.statuses}    # noqa: E731

    def told():
        silent = {name for name, message in newest().items() if 'no image for' in message or 'no pair for' in message}
        return {'plane b', 'pairing'} <= silent <= {'plane b', 'pairing', 'reconstruction'}

    del client.statuses[:]
    assert any(send_one(client, 0) or client.until(told, 0.1) for _ in range(400)), newest()


def test_camera_infos_later_than_their_images_are_waited_for(client):
    """As they come over a busy network: after the next image even."""
    early = [client.send_pixels(GOOD, infos=[]) for _ in range(2)]
    client.until(lambda: False, 0.3)
    assert not set(early) & set(client.paths)
    for stamp in early:
        for k, publisher in enumerate(client.infos):
            info = info_msg(VIEWS[k])
            info.header.stamp, info.header.frame_id = ros.time_msg(stamp), f'plane_{"ab"[k]}_optical'
            publisher.publish(info)
    right(client, early[-1])


def test_camera_infos_that_no_longer_come_hold_after_a_while(client):
    """A C-arm that stands still needs none; but while they came with every image, this one's might be under way."""
    right(client, client.send_pixels(GOOD, infos=[]))


def test_a_camera_that_moves_is_never_mixed_up_with_the_one_before(client):
    for angle in (10, 20, 30):
        views = [ros.projection(angle), ros.projection(angle + 90)]
        right(client, client.send_pixels([ros.draw(P) for P in views], infos=[info_msg(P) for P in views],
                                         infos_last=angle == 20))


def test_a_camera_info_that_contradicts_the_image_size(client):
    stamp = client.send_pixels(GOOD, infos=[info_msg(VIEWS[0], height=SIZE + 1), info_msg(VIEWS[1])])
    assert (says(client, 'reconstruction', 'bad_camera_info', 'plane a', f'{SIZE}x{SIZE + 1}')
            and stamp not in client.paths)


def test_images_of_changing_size_and_encoding(client):
    deep = [image_msg(pixels, encoding='mono16', step=2 * SIZE, data=ros.bytes_of((pixels * np.uint16(257)).tobytes()))
            for pixels in GOOD]
    real = [image_msg(pixels, encoding='32FC1', step=4 * SIZE, data=ros.bytes_of(pixels.astype(np.float32).tobytes()))
            for pixels in GOOD]
    small = [ros.projection(0, 256), ros.projection(90, 256)]
    for pair, infos in ((deep, None), (real, None), ([image_msg(ros.draw(P, 256)) for P in small],
                                                     [info_msg(P, 256) for P in small]), ([deep[0], real[1]], None)):
        right(client, client.send(pair, infos=infos))


def test_a_burst_is_dropped_and_counted_but_for_the_newest(client):
    before, answered = count(client, 'pairing', 'dropped'), len(client.paths)
    stamps = [client.send_pixels(GOOD) for _ in range(5)]       # more would not fit into the queue of the subscription
    assert client.answer(stamps[-1], LIMIT)
    done = lambda: len(client.paths) - answered + count(client, 'pairing', 'dropped') - before      # noqa: E731
    assert client.until(lambda: done() == len(stamps), LIMIT)


def test_jitter_and_loss(client):
    """Up to 200 ms late and out of order, one in twenty lost."""
    rng, first = np.random.default_rng(5), client.now_ns + STEP_NS
    client.now_ns += 40 * STEP_NS
    arrivals = sorted((k * STEP_NS + int(rng.integers(0, 2 * SECOND // 10)), plane, first + k * STEP_NS)
                      for k in range(40) for plane in (0, 1) if rng.random() > 0.05)
    before, pairs = len(client.paths), count(client, 'pairing', 'pairs')
    for _, plane, stamp in arrivals:
        send_one(client, plane, stamp)
        client.until(lambda: False, 0.005)
    assert client.until(lambda: len(client.paths) > before, LIMIT)
    assert set(client.paths) <= {first + k * STEP_NS for k in range(40)} | {t for t in client.paths if t < first}
    assert count(client, 'pairing', 'pairs') > pairs and count(client, 'pairing', 'out of order') > 0


@pytest.mark.parametrize('jump_s', [-300, -1, 3000])
def test_stamps_jump(client, jump_s):
    jumps = count(client, 'pairing', 'jumps back')
    client.now_ns += jump_s * SECOND
    second_good_pair(client)
    assert count(client, 'pairing', 'jumps back') == jumps + (jump_s < 0)


@pytest.mark.parametrize('stamp', [0, (2**31 - 1) * SECOND + 2 * SECOND], ids=['zero', 'beyond'])
def test_stamps_that_say_nothing(client, stamp):
    messages = [image_msg(pixels) for pixels in GOOD]
    for publisher, message in zip(client.images, messages):
        message.header.stamp.sec, message.header.stamp.nanosec = (0, 0) if not stamp else (2**31 - 1, 2 * SECOND)
        publisher.publish(message)
    assert says(client, 'pairing', 'without a stamp')


def test_two_publishers_on_one_topic(client):
    with Client(start_ns=client.now_ns) as other:
        assert other.connected()
        for _ in range(3):
            stamp = client.send_pixels(GOOD)
            other.now_ns = client.now_ns - STEP_NS
            # the same stamps, another picture; which comes first is open
            other.send_pixels([pixels[::-1].copy() for pixels in GOOD])
        assert client.answer(stamp, LIMIT)
        del client.statuses[:]
        assert client.insist(lambda: any(s.name.endswith('plane a') and '2 publishers' in s.message
                                         for s in client.statuses))     # said while images come
        assert count(client, 'pairing', 'duplicates') >= 2


def test_simulated_time_without_and_with_a_clock(client):
    assert client.set('use_sim_time', True).successful
    assert client.insist(lambda: any('no /clock' in s.message for s in client.statuses))
    right(client, client.send_pixels(GOOD))
    clock = client.node.create_publisher(Clock, '/clock', 1)
    del client.statuses[:]
    told = lambda: (clock.publish(Clock(clock=ros.time_msg(77 * SECOND)))    # noqa: E731
                    or any(w in s.message for s in client.statuses for w in ('results/s', 'results are labelled')))
    assert client.insist(told), [s.message for s in client.statuses][-8:]
    client.node.destroy_publisher(clock)
    assert client.set('use_sim_time', False).successful


@pytest.mark.parametrize('reliability', [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT],
                         ids=lambda r: r.name)
def test_transient_local_publishers(client, reliability):
    with Client(reliability, start_ns=client.now_ns, durability=DurabilityPolicy.TRANSIENT_LOCAL) as other:
        assert other.connected()
        assert other.good()
        assert other.value('plane a', 'reliability') == reliability.name.lower()
        client.now_ns = other.now_ns
    # what is taken for one publisher's sake holds while any is left; this is how to go back
    for value in ('reliable', 'auto'):
        assert client.set('image_reliability', value).successful
    assert client.connected() and client.value('plane a', 'reliability') == 'reliable'


def child(code):
    """A process that runs `code` beside the tests."""
    env = {**os.environ, 'ROS_DOMAIN_ID': str(ros.DOMAIN),
           'PYTHONPATH': os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get('PYTHONPATH', '')])}
    return subprocess.Popen([sys.executable, '-c', code], env=env, stdout=subprocess.PIPE, text=True)


def killed(process):
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_subscriber_that_stalls(client):
    """Reliable, and asleep: nobody waits for it."""
    process = child('''if True:
        import rclpy
        from nav_msgs.msg import Path
        from rclpy.qos import HistoryPolicy, QoSProfile
        rclpy.init()
        node = rclpy.create_node('sleeper')
        keep = node.create_subscription(Path, 'backbone', lambda m: print('heard', flush=True),
                                        QoSProfile(history=HistoryPolicy.KEEP_ALL))
        rclpy.spin(node)''')
    try:
        assert client.insist(lambda: client.node.count_subscribers('backbone') == 2)
        process.send_signal(signal.SIGSTOP)
        for _ in range(12):
            right(client, client.send_pixels(GOOD))
    finally:
        killed(process)


def test_a_publisher_that_is_killed_and_comes_again(client):
    code = f'''if True:
        from ros_client import Client, GOOD
        with Client(start_ns={client.now_ns}, domain={ros.DOMAIN}) as publisher:
            print('there', flush=True)
            while True:
                publisher.send_pixels(GOOD)
                publisher.until(lambda: False, 0.05)'''
    for _ in range(2):      # the second one begins where the first one began: its stamps jump back
        client.paths.clear()
        process = child(code)
        try:
            assert client.until(lambda: len(client.paths) > 3, LIMIT)
        finally:
            killed(process)
    client.now_ns = max(client.paths) + 60 * SECOND     # beyond all that it had sent and that was not answered yet


def test_parameters_changed_all_the_time(client):
    service = client.node.create_client(SetParameters, '/fluoro_shape/set_parameters')
    assert service.wait_for_service(LIMIT)
    futures = []
    for k in range(100):
        changes = [Parameter('backbone_spacing', value=0.001 + 1e-5 * (k % 7)),
                   Parameter('image_transport', value='raw'), Parameter('sync_slop', value=0.01 if k % 2 else 5.0)]
        futures.append(service.call_async(SetParameters.Request(parameters=[c.to_parameter_msg() for c in changes])))
        if k % 5 == 0:
            client.send_pixels(GOOD)
        assert client.until(lambda: sum(not f.done() for f in futures) < 5, LIMIT)      # a service's queue holds ten
    assert client.until(lambda: all(f.done() for f in futures), LIMIT)
    assert [[r.successful for r in f.result().results] for f in futures] == [[True, True, k % 2 == 1]
                                                                             for k in range(100)]
    client.node.destroy_client(service)
    assert client.set('backbone_spacing', 0.001).successful


def test_services_under_load(client):
    for _ in range(4):
        for name in ('reset', 'capture_mask', 'clear_mask'):
            client.send_pixels(GOOD)
            assert client.trigger(name).success
        for on in (False, True):
            client.send_pixels(GOOD)
            assert client.call(SetBool, '/fluoro_shape/enable', SetBool.Request(data=on)).success
    assert client.call(Trigger, '/fluoro_shape/reset', Trigger.Request()).success
