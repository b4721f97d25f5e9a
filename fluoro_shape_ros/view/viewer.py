"""Rerun's own program, which draws in its window, or has the page that does; a process beside this one."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from ..cli import ToolError
from .page import LOOPBACK

START_S = 60.0      # to come up
STOP_S = 5.0        # to end


@contextlib.contextmanager
def viewer(data_port: int, page_port: int | None) -> Iterator[subprocess.Popen]:
    """The program, for as long as the block lasts; without a `page_port` it draws in a window. It listens on this
    machine alone.

    Raises ToolError where it does not come up.
    """
    options = (['--expect-data-soon', '--hide-welcome-screen']
               if page_port is None else ['--serve-web', '--web-viewer-port', str(page_port)])
    with tempfile.TemporaryDirectory() as folder:
        forbid_statistics(Path(folder))
        log = Path(folder) / 'log.txt'
        with log.open('w') as output:
            # in a process group of its own: Python's wrapper starts the real one
            process = subprocess.Popen([sys.executable, '-m', 'rerun_cli', *options, '--bind', LOOPBACK, '--port',
                                        str(data_port)], process_group=0,
                                       stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                                       env={**os.environ, 'XDG_CONFIG_HOME': folder})
        try:
            _wait(process, [port for port in (data_port, page_port) if port is not None], log)
            yield process
        finally:
            _end(process)


def forbid_statistics(folder: Path) -> None:
    """Rerun reports how it is used unless its configuration, here one of its own in `folder`, says otherwise."""
    (folder / 'rerun').mkdir()
    (folder / 'rerun' / 'analytics.json').write_text(json.dumps({'analytics_enabled': False, 'analytics_id': '',
                                                                 'metadata': {}}))


def free_port() -> int:
    """A port on this machine at which nobody listens."""
    with socket.create_server((LOOPBACK, 0)) as probe:
        return probe.getsockname()[1]


def _wait(process: subprocess.Popen, ports: list[int], log: Path) -> None:
    deadline = time.monotonic() + START_S
    for port in ports:
        while True:
            with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), 1.0):
                break
            if process.poll() is not None or time.monotonic() > deadline:
                said = log.read_text(errors='replace').strip().splitlines()
                raise ToolError(f'Rerun\'s viewer did not come up: {said[-1] if said else "it said nothing"}')
            time.sleep(0.05)


def _end(process: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(STOP_S)
            return
