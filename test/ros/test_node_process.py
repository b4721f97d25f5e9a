"""The node's process: how it starts and ends, and what it survives."""

import contextlib
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from processes import gone, reconstructing_for
from ros_client import BASE, Client, NodeProcess

from fluoro_shape_ros.resources import resource_path


@pytest.fixture
def log(tmp_path):
    return tmp_path / 'log.txt'


def test_images_before_any_camera_info_a_qos_override_and_sigint(log):
    override = 'qos_overrides./plane_b/image_raw.subscription.reliability:=best_effort'
    with NodeProcess(log, override, ros.RADIUS, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.connected(), node.log
        heard = lambda: any('no_camera_info' in s.message for s in client.statuses)     # noqa: E731
        assert client.insist(heard, infos=[])
        assert client.value('plane b', 'reliability') == 'best_effort'
        path, _ = client.good()
        assert path.header.frame_id == 'plane_a_optical'
        assert node.end(signal.SIGINT) == 0 and 'Traceback' not in node.log


HERE = 'import os; del os.memfd_create'     # so that the node itself reconstructs, and not a process of its own


def spoilt(patch, folder, here):
    """The code of a node where `patch` is run in the process that reconstructs: the node itself (`here`), or its child,
    which takes it from its path."""
    if here:
        return f'{HERE}\n{patch}\nimport sys; from fluoro_shape_ros.node import main; sys.exit(main())'
    (folder / 'sitecustomize.py').write_text(patch)
    return f'import sys; from fluoro_shape_ros.node import main; sys.path.insert(0, {str(folder)!r}); sys.exit(main())'


@pytest.mark.parametrize('here', [True, False], ids=['here', 'there'])
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT], ids=lambda s: s.name)
def test_a_signal_in_the_middle_of_a_pair(log, tmp_path, number, here):
    """A pair that never ends: the worker's thread can't be joined."""
    code = spoilt("""if True:
        import threading
        import fluoro_shape_ros.method.pipeline as pipeline
        pipeline.reconstruct = lambda *_: print('at work', flush=True) or threading.Event().wait()""", tmp_path, here)
    with NodeProcess(log, code=code, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.connected(), node.log
        assert client.insist(lambda: 'at work' in node.log)
        assert node.end(number) == 0 and 'Traceback' not in node.log


@pytest.mark.parametrize('first, second', [
    (signal.SIGINT, signal.SIGINT), (signal.SIGTERM, signal.SIGINT), (signal.SIGINT, signal.SIGTERM),
    (signal.SIGHUP, signal.SIGHUP)])
def test_more_signals_while_it_ends_change_nothing(log, first, second):
    with NodeProcess(log, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.until(lambda: 'images on' in node.log)
        pids = reconstructing_for(node.process.pid)
        node.process.send_signal(first)
        for _ in range(100):        # not for ever: Python is kept busy by signals
            if node.process.poll() is None:
                node.process.send_signal(second)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    node.process.wait(timeout=0.003)
        node.process.wait(timeout=30)
        assert node.process.returncode == 0 and 'Traceback' not in node.log, node.log
        assert len(pids) == 1 and gone(*pids)


def test_the_log_tells_what_it_listens_to_what_is_missing_and_the_first_result(log):
    code = """if True:
        import sys
        from fluoro_shape_ros.ros import node as ros_node
        from fluoro_shape_ros.node import main
        ros_node.WARN_S = 1.0
        sys.exit(main())"""
    given = 'reference_frame:=cell', 'robot_radus:=0.001', 'time_budget:=0', BASE, ros.RADIUS
    with NodeProcess(log, *given, code=code, arguments=('-r', 'plane_b/image_raw:=/lateral'),
                     domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.until(lambda: 'no results: plane a: no image yet' in node.log)
        first, second = node.log.splitlines()[:2]
        assert first.startswith('[WARN]') and first.endswith('there is no parameter robot_radus, but robot_radius')
        assert second.startswith('[INFO]') and all(words in second for words in (
            '/plane_a/image_raw and /lateral', '/plane_a/camera_info and /plane_b/camera_info', '/backbone',
            'frame "cell"', 'method spline', 'robot_radius 1 mm'))
        client.node.destroy_publisher(client.images[1])
        client.images[1] = client.node.create_publisher(ros.Image, '/lateral', 10)
        assert client.connected() and client.insist(lambda: client.paths, every=1.0) and client.good()
        blank = lambda: ('pairs gave a result, most often for no_device_in_plane_a: '    # noqa: E731
                         'no line of at least' in node.log)
        assert client.insist(blank, pair=ros.BLANK)
        assert node.end() == 0 and node.log.count('[INFO]') == 2 and node.log.count('first result') == 1


def test_two_nodes_of_one_name_are_told(log, tmp_path):
    with (NodeProcess(log, domain=ros.OTHER) as node, NodeProcess(tmp_path / 'other.txt', domain=ros.OTHER) as other,
          Client(domain=ros.OTHER) as client):
        words = 'nodes are named /fluoro_shape: end all but one'
        assert client.until(lambda: words in node.log and words in other.log)
        assert client.hears(words) and (node.end(), other.end()) == (0, 0)


@pytest.mark.parametrize('here', [True, False], ids=['here', 'there'])
def test_a_bug_is_told_once_and_counted_and_the_next_pair_goes_on(log, tmp_path, here):
    code = spoilt("""if True:
        import fluoro_shape_ros.method.pipeline as pipeline
        real, left = pipeline.reconstruct, [0, 0]
        def buggy(*arguments):
            if left:
                return [][left.pop()]
            return real(*arguments)
        pipeline.reconstruct = buggy""", tmp_path, here)
    with NodeProcess(log, BASE, ros.RADIUS, code=code, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.connected() and client.insist(lambda: client.paths), node.log
        assert client.value('reconstruction', 'count internal_error') == '2'
        assert node.log.count('Traceback') == 1 and 'IndexError' in node.log


def test_poses_of_moving_planes_come_from_tf(log):
    """tf2_ros, which PyPI does not have, is stood in for; its poses turn with the stamps."""
    code = f"""if True:
        import sys
        from types import SimpleNamespace as Fields
        sys.path.insert(0, {str(Path(ros.__file__).parent)!r})
        import ros_client
        from fluoro_shape_ros.node import main
        from scipy.spatial.transform import Rotation
        class Buffer:
            known_to = 0
            def clear(self):
                self.known_to = 0
            def lookup_transform(self, camera, reference, time, timeout):
                assert reference == 'cell'
                R, t = ros_client.pose_at(camera[len('plane_')], time.nanoseconds)
                vector = lambda names, values: Fields(**dict(zip(names, values)))
                if self.known_to > time.nanoseconds + 10**9:
                    raise LookupError('the pose is too old')    # as tf has it until it is cleared
                self.known_to = max(self.known_to, time.nanoseconds)
                return Fields(transform=Fields(rotation=vector('xyzw', Rotation.from_matrix(R).as_quat()),
                                               translation=vector('xyz', t)))
        sys.modules['tf2_ros'] = Fields(Buffer=Buffer, TransformListener=lambda buffer, node: node,
                                        TransformException=LookupError)
        sys.exit(main())"""
    parameters = ('geometry:=tf', 'reference_frame:=cell', 'time_budget:=0', BASE, ros.RADIUS)
    with NodeProcess(log, *parameters, code=code, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        infos = [ros.info_msg(np.c_[ros.intrinsics(), np.zeros(3)]) for _ in 'ab']
        heard = lambda: any('no_device' in s.message for s in client.statuses)      # noqa: E731
        assert client.connected() and client.insist(heard, pair=ros.BLANK, infos=infos), node.log
        for step_s in (1, 1, -5):
            client.now_ns += step_s * 10**9
            if step_s < 0:      # as a bag that loops
                client.send_pixels(ros.BLANK, infos=infos)
            stamps = [client.now_ns + ros.STEP_NS, client.now_ns + ros.STEP_NS + 5_000_000]
            poses = [np.c_[ros.pose_at(plane, stamp)] for plane, stamp in zip('ab', stamps)]
            path, _ = client.answer(client.send_pixels([ros.draw(ros.intrinsics() @ pose) for pose in poses],
                                                       infos=infos, skew_ns=5_000_000))
            assert path.header.frame_id == 'cell'
            assert np.linalg.norm(ros.points(path)[[0, -1]] - ros.curve()[[0, -1]], axis=1).max() < 0.0025


def test_parameter_files_that_are_installed(tmp_path):
    """Each in a node of its own, in a namespace of its own."""
    yaml = pytest.importorskip('yaml')
    with contextlib.ExitStack() as stack:
        nodes, given = {}, {}
        for name in ('defaults', 'preset_needle', 'preset_catheter', 'preset_concentric_tube'):
            file = resource_path(f'{name}.yaml')
            given[name] = yaml.safe_load(file.read_text())['/**']['ros__parameters']
            arguments = ['--params-file', str(file), '-r', f'__ns:=/{name}']
            nodes[name] = stack.enter_context(NodeProcess(tmp_path / f'{name}.txt', arguments=arguments,
                                                          domain=ros.OTHER))
        client = stack.enter_context(Client(domain=ros.OTHER))
        for name, values in given.items():
            taken = client.get(*values, node=f'/{name}/fluoro_shape')
            assert ([list(new) if isinstance(old, list) else new for old, new in zip(values.values(), taken)]
                    == list(values.values())), name
        assert client.hears('no image yet: nobody publishes /defaults/plane_a/image_raw and '
                            '/defaults/plane_a/camera_info')
        assert client.until(lambda: {s.hardware_id for s in client.statuses}
                                    == {f'/{name}/fluoro_shape' for name in given})
        assert all(s.name.startswith(f'{s.hardware_id}: ') for s in client.statuses)


def test_a_pair_that_takes_long_is_told_and_a_bug_in_a_callback_ends_nothing(log):
    code = f"""if True:
        import sys, threading
        {HERE}
        import fluoro_shape_ros.method.pipeline as pipeline
        from fluoro_shape_ros.ros import node as ros_node
        from fluoro_shape_ros.node import main
        ros_node.OVERDUE_S = 1.0
        real, told, bounded, left = pipeline.reconstruct, threading.Event(), ros_node.bounded, [0]
        def long(*arguments):
            told.wait(60)
            return real(*arguments)
        def buggy(msg):
            return [][left.pop()] if left else bounded(msg)
        def told_of(statuses, *rest, make=ros_node.diagnostic_array):
            if any('takes' in s.message for s in statuses):
                told.set()
            return make(statuses, *rest)
        pipeline.reconstruct, ros_node.bounded, ros_node.diagnostic_array = long, buggy, told_of
        sys.exit(main())"""
    with NodeProcess(log, BASE, ros.RADIUS, code=code, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.connected()
        assert client.insist(lambda: any('the pair at work takes' in s.message for s in client.statuses)), node.log
        assert client.insist(lambda: client.paths), node.log
        assert (int(client.value('reconstruction', 'overdue pairs')) >= 1
                and client.value('reconstruction', 'count internal_error') == '1')
        assert node.log.count('Traceback') == 1 and 'IndexError' in node.log and 'takes more than' in node.log


def run(*arguments, code=None):
    start = ['-m', 'fluoro_shape_ros.node'] if code is None else ['-c', code]
    return subprocess.run([sys.executable, *start, *arguments], capture_output=True, text=True, timeout=60)


def test_help():
    done = run('--help')
    assert done.returncode == 0 and 'sync_slop' in done.stdout and not done.stderr


@pytest.mark.parametrize('arguments, words', [
    (['--speed', '3'], '--speed'),
    (['--ros-args', '-p', 'robot_radius:=-1.0'], 'robot_radius: must lie in'),
    (['--ros-args', '-p', 'polarity'], 'polarity'),
    (['--ros-args', '-p', 'base_position:=5'], 'base_position: needs a list of numbers, got 5'),
    (['--ros-args', '-p', 'use_sim_time:=1'], "'use_sim_time' to '1' of type 'INTEGER', expecting type 'BOOL'"),
    (['--ros-args', '-p', 'tracking:="true"'], "tracking: needs a bool, got 'true'"),
    (['--ros-args', '-p', 'qos_overrides./tip.publisher.depth:=many'],
     'qos_overrides./tip.publisher.depth: needs a whole number'),
    (['--ros-args', '--wings'], '--wings'),
])
def test_unusable_arguments(arguments, words):
    done = run(*arguments)
    assert done.returncode == 2 and words in done.stderr.splitlines()[-1] and 'Traceback' not in done.stderr


def test_without_ros():
    done = run(code='import sys; sys.modules["rclpy"] = None; from fluoro_shape_ros.node import main; sys.exit(main())')
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1 and 'rclpy' in done.stderr
