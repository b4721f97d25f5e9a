"""Where pairs are reconstructed: in a process of its own that is begun anew where it hangs or dies, or, where there can
be none, here. Nothing here imports ROS.

Python lets one thread at a time run: in one process, messages that come hold up the pair at work, and the pair holds
them up. A process of its own can be ended, too, and a library that crashes in it does not take the node along.
"""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from ..config import Config
from ..data import Frame, Outcome, Prior, Reconstruction, View
from .reconstruction_process import Child, Lost, Task
from .shared_arrays import SharedArrays

STARTS = 3              # of processes that may fail in a row, before the work is done here
MANY = 2048 * 2048      # pixels, of which a step may take up to 1 s


@lru_cache(8)
def _pickled(views: tuple[View, View], config: Config) -> bytes:
    return pickle.dumps((views, config))


def why_not() -> str:
    """Why there can't be a process of its own here; empty where there can."""
    if not hasattr(os, 'memfd_create'):
        return 'this system has no memfd_create'
    return 'there is one core only' if len(os.sched_getaffinity(0)) < 2 else ''


def patience_s(config: Config, pixels: int) -> float | None:
    """How long a pair may take before it is said to hang, by the pixels of its larger image: a step of the search has
    no look at the clock, and takes the longer the more of them there are. None where there is no limit: `time_budget`
    is 0, or does not count, as for method:=paper."""
    budget = config.input.time_budget
    return 2 * budget + max(1.0, pixels / MANY) if budget and config.curve.method != 'paper' else None


class Reconstructor:
    """pipeline.reconstruct, in a process of its own where that can work; else in the thread that calls it, and `here`
    says why.

    A context manager: what was begun is ended when it is left. For one thread, except `end`. `told` is called with the
    reason whenever a process was lost; `took_s` is how long the last pair took, without its way there and back.
    """

    _memory: tuple[SharedArrays, ...]
    _mask_places: tuple

    def __init__(self):
        self.here, self.told, self.took_s = '', lambda reason: None, 0.0
        self._child, self._ended, self._changing, self._failed_starts = None, False, threading.Lock(), 0
        # of images and of masks; which masks are there, and where
        self._memory, self._masks, self._mask_places = (), None, ()
        why = why_not()
        if why:
            self._stay_here(why)
        else:
            self._memory = SharedArrays(), SharedArrays()
            self._begin()

    def __enter__(self) -> Reconstructor:
        return self

    def __exit__(self, *_) -> None:
        self.end()
        for resource in filter(None, (self._child, *self._memory)):
            resource.close()

    def end(self) -> None:
        """End the process, whatever it does, and begin no other; a pair at work is given up."""
        with self._changing:
            self._ended = True
            if self._child is not None:
                self._child.kill()

    def get_ready(self) -> float:
        """Wait until a pair can be handed over; for how long that was, s. A process that died meanwhile is begun
        anew."""
        start = time.monotonic()
        while not (self.here or self._ended):
            try:
                self._child.get_ready()
                self._failed_starts = 0
                break
            except Lost as error:
                self._begin_anew(str(error))
        return time.monotonic() - start

    def __call__(self, frame: Frame, config: Config, prior: Prior = Prior(), until: float | None = None,
                 meanwhile: Callable[[], None] = lambda: None) -> Reconstruction:
        """As pipeline.reconstruct; internal_error where the process hung or died over it. `meanwhile` is called
        once it is under way there. Raises BugThere."""
        waited_s = self.get_ready()     # that is nothing the pair took
        if self.here:
            begun = time.monotonic()
            result = self._reconstruct(frame, config, prior, until)
            self.took_s = time.monotonic() - begun
            return result
        try:
            task = self._task(frame, config, prior, until and until + waited_s)
            result, self.took_s = self._child.ask(task, patience_s(config, max(image.size for image in frame.images)),
                                                  meanwhile)
            return result
        except Lost as error:
            self._begin_anew(str(error))
            return Reconstruction(Outcome.INTERNAL_ERROR, f'reconstruction restarted: {error}')

    def _task(self, frame: Frame, config: Config, prior: Prior, until: float | None) -> Task:
        images, masks = self._memory
        if prior.masks is not self._masks:
            self._masks, self._mask_places = prior.masks, masks.put(prior.masks or ())
        places = images.put(frame.images)
        return Task(frame.stamp_ns, frame.frame_id, places, _pickled(frame.views, config),
                    replace(prior, masks=self._mask_places or None), until)

    def _begin_anew(self, reason: str) -> None:
        self._failed_starts += not self._child.ready
        self._child.close()
        self._begin()
        if not self._ended:
            self.told(f'{reason}; {self.here}: from now on in a thread of the node' if self.here else reason)

    def _begin(self) -> None:
        """Begin a process, or give up doing so."""
        with self._changing:
            if self._ended:
                return
            if self._failed_starts == STARTS:
                self._stay_here(f'{STARTS} processes ended before they were ready')
                return
            try:
                self._child = Child(tuple(memory.fd for memory in self._memory))
            except OSError as error:
                self._stay_here(f'no process can be begun: {error}')

    def _stay_here(self, why: str) -> None:
        from ..method.pipeline import reconstruct  # else only the other process needs it
        self._reconstruct, self.here = reconstruct, why
