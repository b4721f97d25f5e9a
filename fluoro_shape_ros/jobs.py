"""Work on many tasks, in processes of this machine or on the workers of a Dask scheduler: the same results, in the same
order."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context, parent_process
from typing import Any

import cv2

from .child_process import end_with
from .cli import ToolError, need

ONE_THREAD = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')
CONNECT_S = 10.0        # for a scheduler to answer
PATIENCE_S = 60.0       # without any worker
LOOK_S = 5.0            # between two looks at whether there are workers
AHEAD = 1000            # tasks that a scheduler holds at a time, so that neither they nor their results pile up there
RETRIES = 2             # of a task that failed where it ran, a file may be missing there; a worker's end does not count


def in_order(function: Callable[[Any], Any], tasks: Sequence, jobs: int = 1, scheduler: str | None = None) -> Iterator:
    """`function(task)` of all tasks in their order, by `jobs` processes of one thread each or by the workers of a Dask
    `scheduler` at this address.

    `function` is one of a module's, and pure: the results do not depend on who makes them. Raises ToolError where a
    process dies, where no scheduler answers, its workers lack this package or all stay away; and whatever a task
    raises.
    """
    return _on_cluster(function, tasks, scheduler) if scheduler else _in_processes(function, tasks, jobs)


# ---- processes of this machine


def _in_processes(function: Callable, tasks: Sequence, jobs: int) -> Iterator:
    with _one_thread_children(), ProcessPoolExecutor(min(jobs, len(tasks)), get_context('spawn'), _start_child) as pool:
        try:
            yield from pool.map(function, tasks)
        except BrokenProcessPool as error:
            raise ToolError('a process that tried scenes was ended from outside or crashed') from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _one_thread_children():
    """Processes started inside get libraries of one thread: these read the environment when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, '1'))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _start_child() -> None:
    end_with(parent_process().pid)      # which may be killed
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # Ctrl-C is the parent's to answer
    cv2.setNumThreads(1)


# ---- workers of a Dask scheduler


@dataclass(frozen=True)
class _Call:
    """Whoever unpickles it gets function(task).

    So a task can travel as bytes, and loading this package is a part of the task: a worker that lacks it says so, where
    one that could not read what it is sent would end, and its scheduler need not have it.
    """

    function: Callable
    task: Any

    def __reduce__(self):
        return _on_worker, (self.function, self.task)


def _on_worker(function: Callable, task: Any) -> Any:
    """Runs on a Dask worker."""
    from distributed import get_worker
    worker = get_worker()
    if worker.state.nthreads > 1:
        raise ToolError(f'worker {worker.address} has {worker.state.nthreads} threads: start it with --nthreads 1')
    cv2.setNumThreads(1)
    return function(task)


def _on_cluster(function: Callable, tasks: Sequence, address: str) -> Iterator:
    distributed = need('distributed', 'cluster')
    for name in ('distributed', 'distributed.client'):
        logging.getLogger(name).setLevel(logging.CRITICAL)      # what matters is raised, in one line
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:      # OSError: TimeoutError too
        raise ToolError(f'no Dask scheduler answers at {address} ({error})') from error
    with client:
        calls = (client.submit(pickle.loads, pickle.dumps(_Call(function, task)), pure=False, retries=RETRIES)
                 for task in tasks)
        ahead = deque(islice(calls, AHEAD))
        while ahead:
            yield _result(client, ahead.popleft(), address)
            ahead.extend(islice(calls, 1))


def _result(client, future, address: str) -> Any:
    """What a task gave; waits for it as long as there are workers."""
    seen = time.monotonic()
    while True:
        try:
            return future.result(timeout=LOOK_S)
        except Exception as error:
            if future.status == 'error':
                _blame_worker(error, address)
                raise
            if not isinstance(error, TimeoutError):     # one of the connection
                raise ToolError(f'the Dask scheduler at {address} went away') from error
        if _has_workers(client):
            seen = time.monotonic()
        elif time.monotonic() - seen > PATIENCE_S:
            raise ToolError(f'the Dask scheduler at {address} has had no worker for {PATIENCE_S:g} s')


def _blame_worker(error: Exception, address: str) -> None:
    """Raises ToolError where a task failed because of those who ran it."""
    from distributed import KilledWorker
    if isinstance(error, ImportError):
        raise ToolError(f'a worker of {address} can\'t load what it needs ({error}): install the same '
                        'fluoro_shape_ros there') from error
    if isinstance(error, KilledWorker):
        raise ToolError(f'a task at {address} ended {error.allowed_failures + 1} workers, one after another') from error


def _has_workers(client) -> bool:
    try:
        return bool(client.nthreads())
    except OSError:     # the scheduler can't be reached, and the future will say so
        return False
