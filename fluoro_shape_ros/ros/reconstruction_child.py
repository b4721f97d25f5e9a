"""The other end of reconstruction_process: a process that reconstructs pair after pair. It ends when the one that began
it does, however that ends."""

from __future__ import annotations

import faulthandler
import gc
import pickle
import sys
import time
from dataclasses import replace
from functools import lru_cache
from multiprocessing.connection import Connection

import cv2

from ..child_process import end_with
from ..data import Frame, Reconstruction
from ..method import judge
from ..method.pipeline import reconstruct
from .reconstruction_process import READY, Bug, Task
from .shared_arrays import SeenArrays

COLLECT_S = 1.0         # between two collections of garbage, which wait for an answer to be out

_known = lru_cache(8)(pickle.loads)     # the same bytes are the same objects, of which other caches know


def main(argv: list[str]) -> int:
    """Serve the process `argv[0]` over the pipe, the images' and the masks' memory whose descriptors follow."""
    parent, pipe, images, masks = map(int, argv)
    end_with(parent)
    faulthandler.enable()
    judge.load()
    gc.freeze()     # as in node.py
    with Connection(pipe) as connection:
        try:
            serve(connection, SeenArrays(images), SeenArrays(masks))
        except (EOFError, BrokenPipeError, ConnectionResetError):   # nobody is there any more
            pass
    return 0


def serve(connection: Connection, images: SeenArrays, masks: SeenArrays) -> None:
    """Answer each Task with a Reconstruction and how long it took, s, or with a Bug.

    A search that was cut short stays here: it is large, and made of steps that can't travel. What travels in its place
    is a number.
    """
    kept, number, threads, collected = None, 0, None, time.monotonic()
    connection.send(READY)
    while True:
        task: Task = connection.recv()
        begun = time.monotonic()
        views, config = _known(task.known)
        if config.input.threads != threads:
            threads = config.input.threads
            cv2.setNumThreads(threads or -1)        # 0 would mean none for OpenCV
        prior = replace(task.prior, masks=task.prior.masks and masks.at(task.prior.masks),
                        search=kept if task.prior.search == number else None)
        kept = None
        try:
            result: Reconstruction = reconstruct(Frame(task.stamp_ns, task.frame_id, images.at(task.images), views),
                                                 config, prior, task.until)
        except Exception as error:  # the node tells it, and the next pair goes on
            connection.send(Bug.of(error))
            continue
        if result.search is not None:
            kept, number = result.search, number + 1
            result = replace(result, search=number)
        connection.send((result, time.monotonic() - begun))
        del prior, result
        if time.monotonic() > collected + COLLECT_S:
            gc.collect()
            collected = time.monotonic()


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
