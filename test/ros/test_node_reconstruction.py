"""The process in which the node has pairs reconstructed, on real topics: what ends it, and what is left of it."""

import os
import signal

import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from processes import gone, reconstructing_for
from ros_client import BASE, Client, NodeProcess

PATIENT = 'time_budget:=1.0'    # a pair hangs after 3 s


@pytest.fixture
def log(tmp_path):
    return tmp_path / 'log.txt'


def pid_of(node, client):
    """Of the process that reconstructs."""
    assert client.until(lambda: len(reconstructing_for(node.process.pid)) == 1), node.log
    return reconstructing_for(node.process.pid)[0]


def shared_memory():
    """The files of /dev/shm but the middleware's."""
    return {name for name in os.listdir('/dev/shm') if 'fast' not in name}


def test_what_ends_the_reconstruction_is_named_and_the_next_pair_answered(log):
    before = shared_memory()
    with NodeProcess(log, PATIENT, BASE, ros.RADIUS, domain=ros.OTHER) as node, Client(domain=ros.OTHER) as client:
        assert client.connected() and client.insist(lambda: client.paths, every=1.0), node.log
        assert (client.value('reconstruction', 'process') == 'its own'
                and client.value('reconstruction', 'reconstruction restarted') == '0')
        for times, (number, words) in enumerate([(signal.SIGKILL, 'it died of SIGKILL'),
                                                 (signal.SIGSTOP, 'it hung: no answer within 3.0 s')], 1):
            del client.statuses[:]
            os.kill(pid_of(node, client), number)
            assert client.insist(lambda: any(f'reconstruction restarted: {words}' in s.message    # noqa: B023
                                             for s in client.statuses), every=1.0), node.log
            assert client.good() and client.value('reconstruction', 'reconstruction restarted') == str(times)
            assert f'reconstruction restarted: {words}' in node.log
        pid = pid_of(node, client)
        assert node.end(signal.SIGHUP) == 0 and gone(pid) and 'Traceback' not in node.log
    assert shared_memory() <= before


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT], ids=lambda s: s.name)
def test_a_process_that_hangs_is_not_left_behind(log, number):
    with (NodeProcess(log, 'time_budget:=0', BASE, ros.RADIUS, domain=ros.OTHER) as node,
          Client(domain=ros.OTHER) as client):
        assert client.connected(), node.log
        pid = pid_of(node, client)
        os.kill(pid, signal.SIGSTOP)
        assert client.insist(lambda: int(client.value('pairing', 'pairs')))
        node.end(number)
        assert (client.until(lambda: gone(pid))
                and node.process.returncode == (-signal.SIGKILL if number == signal.SIGKILL else 0))


def test_where_no_other_process_can_see_the_images_the_node_does_the_work_and_says_so(log):
    code = """if True:
        import os, sys
        from fluoro_shape_ros.node import main
        del os.memfd_create
        sys.exit(main())"""
    with (NodeProcess(log, 'time_budget:=0', BASE, ros.RADIUS, code=code, domain=ros.OTHER) as node,
          Client(domain=ros.OTHER) as client):
        assert client.connected() and client.insist(lambda: client.paths, every=1.0), node.log
        assert (client.value('reconstruction', 'process') == 'the node itself: this system has no memfd_create'
                and not reconstructing_for(node.process.pid))
        told = [line for line in node.log.splitlines()
                if 'not in a process of its own: this system has no memfd_create' in line]
        assert len(told) == 1 and told[0].startswith('[INFO]')
