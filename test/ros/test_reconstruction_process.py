"""Pairs that are reconstructed in a process of its own: the same answers as in this one, whatever ends it is named, and
nothing stays behind. No ROS."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import drawing
import numpy as np
import pytest
from drawing import BLANK, GOOD, VIEWS
from processes import gone, reconstructing_for

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome, Prior
from fluoro_shape_ros.geometry.cameras import make_view
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.ros.reconstruction_process import BugThere
from fluoro_shape_ros.ros.reconstructor import Reconstructor, patience_s

SECONDS = 60        # deadline of whatever must happen: the machine may be busy
CONFIG = Config.from_values(robot_radius=drawing.RADIUS, base_position=drawing.curve()[0].tolist(), time_budget=0.0)
HASTY = CONFIG.replace(time_budget=0.05)
LATE = 1e-9         # a time that is over


def frame(images, stamp_ns=5):
    return Frame(stamp_ns, 'cell', tuple(images),
                 tuple(make_view(name, P, drawing.SIZE, drawing.SIZE) for name, P in zip('ab', VIEWS)))


def until(condition):
    """Whether `condition()` came true before the deadline."""
    deadline = time.monotonic() + SECONDS
    while not condition() and time.monotonic() < deadline:
        threading.Event().wait(0.005)
    return bool(condition())


@pytest.fixture(scope='module')
def shared():
    """One for all."""
    with Reconstructor() as reconstructor:
        assert not reconstructor.here
        yield reconstructor
    assert not reconstructing_for(os.getpid())


@pytest.fixture
def lost(shared):
    """Why processes were lost during a test."""
    reasons = []
    shared.told = reasons.append
    yield reasons
    assert shared(frame(GOOD), CONFIG).outcome is Outcome.OK      # whatever a test did, the next good pair works


def pid_of(reconstructor):
    assert reconstructor.get_ready() >= 0
    pid, = reconstructing_for(os.getpid())
    return pid


def same(one, other):
    """Whether two results say the same."""
    if one.shape is not None and not (np.array_equal(one.shape.points, other.shape.points)
                                      and np.array_equal(one.shape.covariance, other.shape.covariance)):
        return False
    return (one.outcome, one.detail, one.warnings, one.search is None) == (other.outcome, other.detail, other.warnings,
                                                                           other.search is None)


def test_the_answers_are_those_of_the_pipeline(shared, lost):
    """A search, a tracked pair, and images and masks of other sizes between them."""
    first = reconstruct(frame(GOOD), CONFIG)
    assert first.outcome is Outcome.OK and same(shared(frame(GOOD), CONFIG), first)
    prior = Prior(previous=first.shape, previous_stamp_ns=5)
    wide = [np.pad(image, ((0, 0), (0, 9)), mode='edge').astype(np.uint16) * 100 for image in GOOD]
    masks = tuple(image.astype(np.float32) for image in BLANK)
    for images, given in ((GOOD, prior), (wide, Prior()), (GOOD, replace(prior, masks=masks)),
                          (BLANK, Prior(masks=masks)), (GOOD, Prior())):
        assert same(shared(frame(images, 7), CONFIG, given), reconstruct(frame(images, 7), CONFIG, given))
    assert lost == []


def test_a_search_that_was_cut_short_goes_on_where_it_stopped(shared, lost):
    """It stays in the other process, whose images are overwritten meanwhile."""
    def answers(method):
        prior, found = Prior(), []
        for images in (BLANK, *[GOOD] * 6):     # a pair that takes some steps, then one that its search goes on for
            found.append(method(frame(images), HASTY.replace(time_budget=0.0), prior, LATE))
            prior = Prior(search=found[-1].search)
        return found
    there, here = answers(shared), answers(reconstruct)
    assert any(result.search is not None for result in here)
    assert all(map(same, there, here)) and lost == []


def test_a_process_that_died_between_two_pairs_is_begun_anew_and_the_next_one_answered(shared, lost):
    pid = pid_of(shared)
    os.kill(pid, signal.SIGSEGV)
    assert until(lambda: gone(pid))
    assert shared(frame(GOOD), CONFIG).outcome is Outcome.OK and lost == ['it died of SIGSEGV']
    assert pid_of(shared) != pid


def test_a_process_that_dies_over_a_pair_costs_that_pair(shared, lost):
    pid = pid_of(shared)
    os.kill(pid, signal.SIGSTOP)
    threading.Timer(0.1, os.kill, (pid, signal.SIGKILL)).start()
    result = shared(frame(GOOD), CONFIG)
    assert ((result.outcome, result.detail) == (Outcome.INTERNAL_ERROR, 'reconstruction restarted: it died of SIGKILL')
            and lost == ['it died of SIGKILL'])


def test_a_process_that_hangs_is_ended(shared, lost):
    pid = pid_of(shared)
    os.kill(pid, signal.SIGSTOP)
    result = shared(frame(GOOD), HASTY)
    assert (result.outcome, result.detail) == (Outcome.INTERNAL_ERROR, 'reconstruction restarted: it hung: '
                                                                       'no answer within 1.1 s') and gone(pid)
    assert lost == ['it hung: no answer within 1.1 s']


@pytest.mark.parametrize('budget, method, pixels, limit', [
    (0.2, 'spline', 1024**2, 1.4), (0.5, 'spline', 1024**2, 2.0), (0.2, 'spline', 4096**2, 4.4),
    (0.0, 'spline', 1024**2, None), (0.2, 'paper', 1024**2, None)])
def test_how_long_a_pair_may_take(budget, method, pixels, limit):
    assert (patience_s(Config.from_values(time_budget=budget, method=method), pixels)
            == (None if limit is None else pytest.approx(limit)))


def test_a_bug_over_there_is_told_here_and_the_next_pair_goes_on(shared, lost):
    with pytest.raises(BugThere, match='^AttributeError: ') as raised:
        shared(frame(GOOD), CONFIG, Prior(previous='no shape', previous_stamp_ns=1))
    assert (raised.value.bug.kind.startswith('AttributeError in /')
            and raised.value.bug.trace.startswith('Traceback') and lost == [])


def test_who_ends_it_need_not_wait_for_the_pair_at_work():
    others, results = reconstructing_for(os.getpid()), []
    with Reconstructor() as reconstructor:
        reconstructor.get_ready()
        pid, = set(reconstructing_for(os.getpid())) - set(others)
        os.kill(pid, signal.SIGSTOP)
        at_work = threading.Thread(target=lambda: results.append(reconstructor(frame(GOOD), CONFIG)))
        at_work.start()
        reconstructor.end()
        at_work.join(SECONDS)
        assert [r.outcome for r in results] == [Outcome.INTERNAL_ERROR] and gone(pid)
        reconstructor.end()
        assert reconstructing_for(os.getpid()) == others


def test_it_ends_with_the_process_that_began_it_even_where_it_hangs():
    code = """if True:
        import sys
        from fluoro_shape_ros.ros.reconstructor import Reconstructor
        with Reconstructor() as reconstructor:
            reconstructor.get_ready()
            print('ready', flush=True)
            sys.stdin.read()"""
    places = [str(Path(sys.modules['fluoro_shape_ros'].__file__).parents[1]), os.environ.get('PYTHONPATH', '')]
    with subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(places)}) as parent:
        assert parent.stdout.readline() == b'ready\n'
        pid, = reconstructing_for(parent.pid)
        os.kill(pid, signal.SIGSTOP)
        parent.kill()
    assert until(lambda: gone(pid))


@pytest.fixture
def answered_here():
    """Whether a good pair is answered though there is no process but the ones before."""
    others = reconstructing_for(os.getpid())    # before one is begun that may take its time to end
    return lambda reconstructor: (reconstructor(frame(GOOD), CONFIG).outcome is Outcome.OK
                                  and reconstructing_for(os.getpid()) == others)


@pytest.mark.parametrize('program, why, told', [
    ('/bin/false', '3 processes ended before they were ready', ['it ended with exit code 1'] * 3),
    ('/no/such/python', 'no process can be begun', []),
])
def test_where_no_process_gets_ready_this_one_does_the_work(monkeypatch, answered_here, program, why, told):
    monkeypatch.setattr(sys, 'executable', program)
    with Reconstructor() as reconstructor:
        reasons = []
        reconstructor.told = reasons.append
        assert answered_here(reconstructor) and why in reconstructor.here
    # the first one may end before anybody is there to be told
    assert (len(told) - 1 <= len(reasons) <= len(told)
            and all(reason.startswith(start) for reason, start in zip(reasons, told)))


def test_where_there_is_one_core_this_process_does_the_work(monkeypatch, answered_here):
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: {0})
    with Reconstructor() as reconstructor:
        assert answered_here(reconstructor) and reconstructor.here == 'there is one core only'


def test_where_there_is_no_nameless_memory_this_process_does_the_work(monkeypatch, answered_here):
    monkeypatch.delattr(os, 'memfd_create')
    with Reconstructor() as reconstructor:
        assert answered_here(reconstructor) and 'memfd_create' in reconstructor.here
