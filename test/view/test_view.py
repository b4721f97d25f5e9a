"""fluoro_shape_view from bags and from topics, into files that are read back; and what it says where it can't."""

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager

import pytest

rerun = pytest.importorskip('rerun')
import numpy as np
import recording
from drawing import BASE, BLANK, CALIBRATIONS, GOOD, SIZE, VIEWS, curve

from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.demo import main as demo
from fluoro_shape_ros.geometry.cameras import make_view
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.overlay import overlay
from fluoro_shape_ros.view import main, recorded
from fluoro_shape_ros.view.node_view import DIAGNOSTICS, LATENCY, TOPICS
from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.diagnostics import OK, Status, diagnostic_array
from msg_adapters.images import array_to_image
from msg_adapters.messages import ros_message
from msg_adapters.shapes import shape_to_cloud, shape_to_path, shape_to_tip_pose

DOMAIN = 1 + 2 * (os.getpid() % 50)
S = np.linspace(0.0, arc_length(curve())[-1], 50)
SHAPE = Shape(at_arc_length(curve(), S), S, np.tile(1e-8 * np.eye(3), (50, 1, 1)), np.zeros((50, 2)))
PAIR = tuple(make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS))
BOTH = ('plane_a', 'plane_a/picture', 'plane_b', 'plane_b/picture', 'source_a', 'source_b', 'detector_a',
        'device/backbone', 'device/ellipsoid', 'tip/ellipsoid',
        'confidence/published', 'millimetres/tip_sigma', 'pairs/ok', 'log')


@pytest.fixture(autouse=True)
def own_signals():
    """Handlers of signals are put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Results of two good pairs and one without a device, with their images."""
    folder = tmp_path_factory.mktemp('bag')
    recording.record(folder / 'run', [GOOD, BLANK, GOOD])
    assert recording.main(folder / 'run', '--out', folder / 'results', '--with-images', '-p', BASE) == 0
    return folder / 'results'


def rows(path, tmp_path):
    """The rows of every entity in an .rrd file, as Rerun's own program reads it."""
    done = subprocess.run([sys.executable, '-m', 'rerun_cli', 'rrd', 'print', str(path)], capture_output=True,
                          text=True, timeout=120, env={**os.environ, 'XDG_CONFIG_HOME': str(tmp_path)})
    assert done.returncode == 0, done.stderr
    found = Counter()
    for count, entity in re.findall(r'with (\d+) rows .* - /(\S+) - ', done.stdout):
        found[entity] += int(count)
    return found


# ---- bags


def test_results_with_images_become_a_file_that_rerun_reads(bag, tmp_path):
    assert main.main(['--bag', str(bag), '--save', str(tmp_path / 'all.rrd')]) == 0
    found = rows(tmp_path / 'all.rrd', tmp_path)
    assert {f'fluoro_shape/{path}' for path in BOTH} | {'fluoro_shape/plane_a/backbone', 'fluoro_shape/plane_b/tip',
                                                        'fluoro_shape/pairs/no_device_in_plane_a'} <= found.keys()
    # its style alone: a replay has no latency
    assert 'fluoro_shape/milliseconds/node' in found and found['fluoro_shape/milliseconds/node'] <= 2


def test_without_images_there_are_only_results(bag, tmp_path):
    assert main.main(['--bag', str(bag), '--save', str(tmp_path / 'bare.rrd'), '--no-images']) == 0
    found = rows(tmp_path / 'bare.rrd', tmp_path)
    assert ({'fluoro_shape/device/backbone', 'fluoro_shape/source_a'} <= found.keys()
            and not [path for path in found if path.endswith('/picture')])


def test_topics_are_found_in_namespaces_where_they_were_remapped_and_compressed():
    cloud, path, image, small = ('sensor_msgs/msg/PointCloud2', 'nav_msgs/msg/Path', 'sensor_msgs/msg/Image',
                                 'sensor_msgs/msg/CompressedImage')
    types = {'/lab/backbone_points': cloud, '/lab/ground_truth/backbone': path, '/lab/plane_a/overlay': image,
             '/lab/plane_a/image_raw': image, '/lab/plane_b/image_raw/compressed': small, '/xray/frontal': image,
             '/backbone': path, '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray'}
    assert recorded.namespaces(types) == ['/', '/lab']
    always = {'/diagnostics': '/diagnostics'}
    assert recorded.topics_of('/lab', types, {}, True) == always | {
        '/lab/backbone_points': 'backbone_points', '/lab/ground_truth/backbone': 'ground_truth/backbone',
        '/lab/plane_a/overlay': 'plane_a/overlay', '/lab/plane_b/image_raw/compressed': 'plane_b/image_raw'}
    assert (recorded.topics_of('/', types, {'plane_a/image_raw': '/xray/frontal'}, True)
            == always | {'/backbone': 'backbone', '/xray/frontal': 'plane_a/image_raw'})
    assert (recorded.topics_of('/', types, {'plane_a/image_raw': '/xray/frontal'}, False)
            == always | {'/backbone': 'backbone'})


def test_a_damaged_bag_is_shown_as_far_as_it_goes_and_named(bag, tmp_path, capsys):
    (tmp_path / 'cut').mkdir()
    for file in bag.glob('*.mcap'):
        (tmp_path / 'cut' / file.name).write_bytes(file.read_bytes())
    assert main.main(['--bag', str(tmp_path / 'cut'), '--save', str(tmp_path / 'cut.rrd')]) == 1
    told = capsys.readouterr().err
    assert told.count('\n') == 1 and 'metadata.yaml is missing' in told
    assert 'fluoro_shape/device/backbone' in rows(tmp_path / 'cut.rrd', tmp_path)


def test_the_demo_starts_the_page_where_it_is_asked_for():
    named = [demo.commands(demo._parser().parse_args(arguments)) for arguments in ([], ['--view'])]
    assert [list(commands) for commands in named] == [['node', 'sim'], ['view', 'node', 'sim']]
    assert main.make_parser().parse_args(named[1]['view'][2:]).web and named[1]['view'][1] == main.__name__


# ---- what can't be


@pytest.mark.parametrize('arguments, code, words', [
    (['--bag', '{folder}/nowhere', '--save', '{tmp}/a.rrd'], 1, 'no such bag'),
    (['--bag', '{folder}/run', '--save', '{tmp}/a.rrd'], 1, 'no results'),
    (['lab', '--bag', '{folder}/results', '--save', '{tmp}/a.rrd'], 1, 'those in it are in /'),
    (['--bag', '{folder}/results', '--save', '{tmp}/none/a.rrd'], 1, 'a.rrd'),
    (['--bag', '{folder}/results', '--save', '{tmp}/there.rrd'], 1, 'not overwritten'),
    (['--bag', '{folder}/results'], 1, '--web'),
    (['--save', '{tmp}/a.rrd', '--web'], 2, 'not allowed'),
    (['one lab', '--save', '{tmp}/a.rrd'], 2, 'no namespace'),
    (['-r', 'nonsense', '--save', '{tmp}/a.rrd'], 2, 'FROM:=TO'),
    (['--port', '70000', '--web'], 2, 'port'),
])
def test_what_can_not_be_is_named(arguments, code, words, bag, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    (tmp_path / 'there.rrd').touch()
    given = [argument.format(folder=bag.parent, tmp=tmp_path) for argument in arguments]
    try:
        assert main.main(given) == code
    except SystemExit as ended:
        assert ended.code == code
    told = capsys.readouterr().err
    assert words in told and (code == 2 or told.count('\n') == 1), told
    assert not (tmp_path / 'a.rrd').exists() and (tmp_path / 'there.rrd').stat().st_size == 0


@pytest.mark.parametrize('blocked, extra, arguments', [('rerun', 'view', ['--bag', 'any']), ('rclpy', 'ros', [])])
def test_what_is_not_installed_is_named(blocked, extra, arguments):
    code = (f'import sys\nsys.modules[{blocked!r}] = None\nfrom fluoro_shape_ros.view.main import main\n'
            f'sys.exit(main({arguments!r}))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, timeout=60)
    assert (done.returncode == 1 and done.stderr.count('\n') == 1
            and f'fluoro_shape_ros[{extra}]' in done.stderr), done.stderr


# ---- topics


@contextmanager
def process(*arguments, domain=DOMAIN, **options):
    """fluoro_shape_view, ended with the block."""
    child = subprocess.Popen([sys.executable, '-m', 'fluoro_shape_ros.view.main', *map(str, arguments)],
                             stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                             env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, **options)
    try:
        yield child
    finally:
        if child.poll() is None:
            child.terminate()
        child.communicate(timeout=60)


def test_nobody_there_is_said_in_one_line(tmp_path):
    pytest.importorskip('rclpy')
    with process('lab', 'other', '--wait', 1, '--save', tmp_path / 'a.rrd') as child:
        told, _ = child.communicate(timeout=100)
    assert (child.returncode == 1 and told.count('\n') == 1 and '/lab, /other' in told
            and not (tmp_path / 'a.rrd').exists())


def messages(stamp):
    """What a node with ground truth publishes of a good pair, by topic."""
    result = Reconstruction(Outcome.OK, shape=SHAPE, confidence=0.97)
    said = {'last outcome': 'ok', 'mask': 'none', LATENCY: '31.0', 'count ok': '5'}
    told = {DIAGNOSTICS[0]: diagnostic_array([Status('reconstruction', OK, '5.0 results/s', said)], stamp,
                                             '/lab/fluoro_shape', ros_message),
            'ground_truth/backbone': shape_to_path(SHAPE, stamp, 'world', ros_message),
            'tip_pose': shape_to_tip_pose(SHAPE, stamp, 'world', ros_message),
            'backbone_points': shape_to_cloud(SHAPE, 0.97, stamp, 'world', ros_message)}
    for k, (plane, calibration) in enumerate(zip('ab', CALIBRATIONS)):
        told[f'plane_{plane}/camera_info'] = calibration_to_camera_info(calibration, stamp, f'plane_{plane}',
                                                                        ros_message)
        told[f'plane_{plane}/overlay'] = array_to_image(overlay(GOOD[k], k, result, PAIR)[::2, ::2], stamp, 'world',
                                                        ros_message)
    return told


def test_a_node_is_shown_while_it_publishes(tmp_path):
    rclpy = pytest.importorskip('rclpy')
    from rclpy.context import Context
    file, context = tmp_path / 'live.rrd', Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = rclpy.create_node('as_a_node', namespace='lab', context=context, enable_rosout=False)
    kinds = dict([*TOPICS.items(), DIAGNOSTICS])
    publishers = {topic: node.create_publisher(type(message), topic, 5) for topic, message in messages(0).items()}
    try:
        assert publishers.keys() == kinds.keys()
        with process('lab', '--wait', 60, '--save', file) as child:
            deadline, sent = time.monotonic() + 60, 0
            # until more has been written than the styles and some pairs
            while (time.monotonic() < deadline and child.poll() is None
                   and not (file.exists() and file.stat().st_size > 600_000)):
                sent += 1
                for topic, message in messages(time.time_ns()).items():
                    publishers[topic].publish(message)
                select.select([], [], [], 0.1)
            child.send_signal(signal.SIGINT)
            told, _ = child.communicate(timeout=60)
    finally:
        node.destroy_node()
        context.try_shutdown()
    assert child.returncode == 0 and '/lab is heard' in told and 'Traceback' not in told, (sent, told)
    found = rows(file, tmp_path)
    assert {f'lab/{path}' for path in (*BOTH, 'truth', 'tip/truth', 'millimetres/tip_error', 'milliseconds/node',
                                       'milliseconds/here')} <= found.keys()
    assert min(found[f'lab/{path}'] for path in ('plane_a/picture', 'device/backbone', 'truth')) > 1
