"""Tasks in order, by processes of this machine and by workers of a real Dask scheduler: the same numbers, whoever ends
in between."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from cluster import HOST, PATIENCE_S, Cluster, free_port
from processes import gone
from test_bench_variety import drawn, hide, save

from fluoro_shape_ros import jobs
from fluoro_shape_ros.bench import main
from fluoro_shape_ros.bench.families import Sources
from fluoro_shape_ros.bench.score import Task, attempt
from fluoro_shape_ros.bench.variety import plain_trial
from fluoro_shape_ros.cli import ToolError

THREADS = '__import__("cv2").getNumThreads()'
WHO = '__import__("os").getpid()'


# ---- processes of this machine


def test_processes_keep_the_order_and_have_one_thread():
    before = {name: os.environ.get(name) for name in jobs.ONE_THREAD}
    assert list(jobs.in_order(eval, ['3 * 7', THREADS, *(f'__import__("os").environ["{name}"]'
                                                         for name in jobs.ONE_THREAD)], 2)) == [21, 1, '1', '1', '1']
    assert {name: os.environ.get(name) for name in jobs.ONE_THREAD} == before


def test_they_end_with_the_process_that_began_them_however_that_ends():
    code = """if __name__ == '__main__':
        import os, sys
        from fluoro_shape_ros import jobs
        results = jobs.in_order(eval, ['__import__("os").getpid()', '__import__("time").sleep(600)'], 1)
        print(next(results), flush=True)
        next(results)"""
    places = [str(Path(jobs.__file__).parents[1]), os.environ.get('PYTHONPATH', '')]
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE,
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(places)}) as parent:
        pid = int(parent.stdout.readline())
        assert not gone(pid)
        parent.kill()
    deadline = time.monotonic() + 60
    while not gone(pid) and time.monotonic() < deadline:
        threading.Event().wait(0.005)
    assert gone(pid)


def test_what_a_task_raises_comes_out_and_a_dead_process_is_named():
    results = jobs.in_order(math.sqrt, [4.0, -1.0], 1)
    assert next(results) == 2.0
    with pytest.raises(ValueError):
        next(results)
    with pytest.raises(ToolError, match='ended from outside or crashed'):
        list(jobs.in_order(os._exit, [3], 1))


# ---- a Dask scheduler


@pytest.fixture(scope='module')
def cluster(tmp_path_factory):
    pytest.importorskip('distributed')
    cluster = Cluster(tmp_path_factory.mktemp('cluster'))
    yield cluster
    cluster.end()


@pytest.fixture
def impatient(monkeypatch):
    for name, seconds in (('PATIENCE_S', 0.5), ('LOOK_S', 0.2), ('CONNECT_S', 0.5)):
        monkeypatch.setattr(jobs, name, seconds)


def numbers(trial):
    """All of a trial but what it cost."""
    plain = plain_trial(trial)
    for answer in plain['answers'].values():
        assert answer.pop('cpu_s') > 0
    return plain


def test_a_killed_worker_changes_no_number(cluster, tmp_path, monkeypatch):
    """Four tasks at a time are with the scheduler: when the second result is here and a worker is killed, others are
    still to be sent."""
    monkeypatch.setattr(jobs, 'AHEAD', 4)
    for seed in range(10):
        save(tmp_path / 'scenes' / str(seed), drawn(seed))
    hide(tmp_path / 'scenes' / '5')
    tasks = [Task('open', seed, ('spline',), sources=Sources(open=tmp_path / 'scenes'), min_confidence=0.5)
             for seed in range(10)]
    expected = [numbers(trial) for trial in jobs.in_order(attempt, tasks, 2)]
    assert {t['answers']['spline']['right'] for t in expected} == {True, False}
    one, other = cluster.workers(2)
    found = []
    for trial in jobs.in_order(attempt, tasks, scheduler=cluster.address):
        found.append(numbers(trial))
        if len(found) == 2:
            os.kill(one.pid, signal.SIGKILL)
    assert found == expected and one.wait(PATIENCE_S) == -signal.SIGKILL
    assert list(jobs.in_order(eval, ['3 * 7', WHO, THREADS], scheduler=cluster.address)) == [21, other.pid, 1]
    cluster.without(other)


def test_what_a_task_raises_on_a_worker_comes_out(cluster):
    worker, = cluster.workers(1)
    results = jobs.in_order(math.sqrt, [4.0, -1.0], scheduler=cluster.address)
    assert next(results) == 2.0
    with pytest.raises(ValueError):
        next(results)
    with pytest.raises(ToolError, match='scene.json|no such folder'):
        list(jobs.in_order(attempt, [Task('open', 0, ('spline',), sources=Sources(open=Path('/no/such/folder')))],
                           scheduler=cluster.address))
    cluster.without(worker)


def test_tasks_are_sent_as_results_are_taken(cluster, monkeypatch):
    monkeypatch.setattr(jobs, 'AHEAD', 4)
    worker, = cluster.workers(1)
    sent = []
    results = jobs.in_order(abs, (sent.append(k) or -k for k in range(20)), scheduler=cluster.address)
    assert [(next(results), len(sent)) for _ in range(3)] == [(0, 4), (1, 5), (2, 6)]
    results.close()
    cluster.without(worker)


def test_workers_without_this_package_or_with_many_threads_are_named(cluster):
    for options, code, words in (((), 'import sys; sys.modules["fluoro_shape_ros"] = None',
                                  'install the same fluoro_shape_ros there'),
                                 (('--nthreads', '2'), '', 'has 2 threads: start it with --nthreads 1')):
        worker, = cluster.workers(1, *options, code=code)
        with pytest.raises(ToolError, match=words):
            list(jobs.in_order(abs, [1], scheduler=cluster.address))
        cluster.without(worker)


def test_without_workers_for_long_it_ends(cluster, impatient):
    with pytest.raises(ToolError, match='has had no worker for 0.5 s'):
        list(jobs.in_order(abs, [1], scheduler=cluster.address))
    cluster.workers(1)
    with pytest.raises(ToolError, match='has had no worker for 0.5 s'):
        list(jobs.in_order(os._exit, [3], scheduler=cluster.address))


def test_a_task_that_ends_its_workers_and_a_scheduler_that_goes_away_are_named(tmp_path):
    pytest.importorskip('distributed')
    cluster = Cluster(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0')
    try:
        cluster.workers(1)
        with pytest.raises(ToolError, match='ended 1 workers'):
            list(jobs.in_order(os._exit, [3], scheduler=cluster.address))
        results = jobs.in_order(math.sqrt, [4.0, 9.0], scheduler=cluster.address)
        cluster.workers(1)
        assert next(results) == 2.0
        cluster.scheduler.kill()
        with pytest.raises(ToolError, match='went away'):
            next(results)
    finally:
        cluster.end()


def test_command_says_in_one_line_that_no_scheduler_answers(impatient, capfd):
    pytest.importorskip('distributed')
    for address, words in ((f'{HOST}:{free_port()}', 'no Dask scheduler answers at'), ('nonsense', 'missing port')):
        assert main.main(['variety', '--families', 'wide', '--scenes', '1', '--scheduler', address]) == 1
        error = capfd.readouterr().err.splitlines()
        assert words in error[-1] and error[-1].startswith('fluoro_shape_bench: ')
