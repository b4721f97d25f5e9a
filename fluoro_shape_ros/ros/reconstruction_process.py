"""A process that reconstructs, from the side of the one that begins it: what goes to and fro, and how it is asked,
watched and ended. Nothing here imports ROS.

Images go through memory that both see; all else is small, and goes pickled through a pipe. The other side is
reconstruction_child.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import Pipe

from ..data import Prior, Reconstruction
from .shared_arrays import Place

READY = 'ready'
START_S = 30.0          # for a process to be ready
MOMENT_S = 0.01         # less than that is not worth waiting for
END_S = 5.0             # for a process that was killed to be gone


@dataclass(frozen=True)
class Task:
    """A pair as it travels: the arguments of pipeline.reconstruct, but for pixels."""

    stamp_ns: int
    frame_id: str
    images: tuple[Place, Place]
    known: bytes                # views and Config, pickled: what stays the same is the same object again at the other
                                # end
    prior: Prior                # its masks are Places
    until: float | None


@dataclass(frozen=True)
class Bug:
    """An exception that nobody foresaw, in words."""

    kind: str                   # its type and where it was raised
    words: str                  # its type and what it says
    trace: str

    @classmethod
    def of(cls, error: Exception) -> Bug:
        place, name = traceback.extract_tb(error.__traceback__)[-1], type(error).__name__
        return cls(f'{name} in {place.filename}:{place.lineno}', f'{name}: {error}',
                   ''.join(traceback.format_exception(error)))


class BugThere(Exception):
    """An exception that nobody foresaw was raised in the other process."""

    def __init__(self, bug: Bug):
        super().__init__(bug.words)
        self.bug = bug


class Lost(Exception):
    """The process hangs or has died; the message says which."""


class Child:
    """One such process; `fds` are the memory that it sees. Raises OSError where it can't be begun. It ends when this
    one does, however that ends."""

    def __init__(self, fds: tuple[int, ...]):
        self._pipe, theirs = Pipe()
        self.ready, self._scheduled = False, -1
        try:
            handed = (theirs.fileno(), *fds)
            # in a process group of its own: Ctrl-C in the terminal is for the node, which may still want an answer
            self._process = subprocess.Popen(
                [sys.executable, '-P', '-m', f'{__package__}.reconstruction_child',
                 str(os.getpid()), *map(str, handed)], pass_fds=handed,
                process_group=0, stdin=subprocess.DEVNULL,
                env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(os.path.abspath, sys.path))})
        except BaseException:
            self._pipe.close()
            raise
        finally:
            theirs.close()
        with contextlib.suppress(OSError):
            self._scheduled = os.open(f'/proc/{self._process.pid}/schedstat', os.O_RDONLY)

    def get_ready(self) -> None:
        """Wait until it can take a task. Raises Lost."""
        if not self.ready:
            self.ready = self._heard(START_S) == READY
        elif self._pipe.poll():     # nothing was asked: that is its end
            self._heard(0.0)

    def ask(self, task: Task, limit_s: float | None, meanwhile: Callable[[], None]) -> tuple[Reconstruction, float]:
        """The answer to a task, and how long it took over there, s; `meanwhile` is called once it is under way. Raises
        Lost, and BugThere."""
        try:
            self._pipe.send(task)
        except OSError:
            raise Lost(self._last_words()) from None
        meanwhile()
        answer = self._heard(limit_s)
        if isinstance(answer, Bug):
            raise BugThere(answer)
        return answer

    def kill(self) -> None:
        """End it, whatever it does; may be called from any thread."""
        self._process.kill()

    def close(self) -> None:
        """End it, and leave nothing behind."""
        self.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):    # one deep in a call of the system ends when that does
            self._process.wait(END_S)
        with contextlib.suppress(OSError):
            os.close(self._scheduled)
        self._scheduled = -1
        self._pipe.close()

    def _heard(self, limit_s: float | None):
        """What it says next, in limit_s at most during which it could have run: where others take all cores it does not
        hang. Raises Lost."""
        left_s, starved_s = limit_s, self._starved_s()
        try:
            while not self._pipe.poll(left_s):
                now_s = self._starved_s()
                left_s, starved_s = now_s - starved_s, now_s
                if left_s < MOMENT_S:
                    raise Lost(f'it hung: no answer within {limit_s:.1f} s')
            return self._pipe.recv()
        except (EOFError, OSError):
            raise Lost(self._last_words()) from None

    def _starved_s(self) -> float:
        """How long it has waited for a core in all (proc(5)); 0 where the kernel does not tell."""
        try:
            return int(os.pread(self._scheduled, 99, 0).split()[1]) / 1e9
        except (OSError, IndexError):
            return 0.0

    def _last_words(self) -> str:
        try:
            code = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            return 'it fell silent'
        return f'it died of {signal.Signals(-code).name}' if code < 0 else f'it ended with exit code {code}'
