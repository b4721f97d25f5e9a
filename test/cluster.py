"""A Dask scheduler and workers on loopback, for tests."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import fluoro_shape_ros
from fluoro_shape_ros import jobs

PATIENCE_S = 60.0       # for what a test waits for
HOST = '127.0.0.1'


def free_port() -> int:
    with socket.socket() as s:
        s.bind((HOST, 0))
        return s.getsockname()[1]


class Cluster:
    """A scheduler and workers, each a process; all end with it."""

    def __init__(self, folder: Path, **settings):
        self._folder, self._processes = folder, []
        self._environment = {**os.environ, **dict.fromkeys(jobs.ONE_THREAD, '1'), **settings,
                             'PYTHONPATH': str(Path(fluoro_shape_ros.__file__).parents[1])}
        self.address = f'tcp://{HOST}:{free_port()}'
        self.scheduler = self._start('scheduler', '--port', self.address.rpartition(':')[2])
        self._client = pytest.importorskip('distributed').Client(self.address, timeout=PATIENCE_S, set_as_default=False)

    def workers(self, number: int, *options: str, code: str = '') -> list[subprocess.Popen]:
        """So many workers of one thread, and no others, once the scheduler knows them; `code` comes before all else
        that they do."""
        started = [self._start('worker', self.address, '--nthreads', '1', '--no-nanny', '--local-directory',
                               str(self._folder), *options, code=code)
                   for _ in range(number)]
        self._client.wait_for_workers(number, timeout=PATIENCE_S)
        return started

    def without(self, *processes: subprocess.Popen) -> None:
        """End these, once the scheduler has no worker any more."""
        for process in processes:
            process.kill()
            process.wait(PATIENCE_S)
        deadline = time.monotonic() + PATIENCE_S
        while self._client.nthreads():
            assert time.monotonic() < deadline

    def _start(self, what: str, *arguments: str, code: str = '') -> subprocess.Popen:
        command = [sys.executable, '-c', f'{code}\nfrom distributed.cli.dask_{what} import main\nmain()', *arguments,
                   '--host', HOST, '--no-dashboard', '--dashboard-address', f'{HOST}:0']
        with (self._folder / f'{len(self._processes)}.log').open('w') as log:
            self._processes.append(subprocess.Popen(command, env=self._environment, stdout=log, stderr=log,
                                                    cwd=self._folder))
        return self._processes[-1]

    def end(self) -> None:
        self._client.close(timeout=1)
        for process in reversed(self._processes):
            process.kill()
            process.wait(PATIENCE_S)
