"""Both planes at once: worth it for work on whole images, during which NumPy and OpenCV let go of the interpreter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

FEW = 2**19     # pixels of both planes that are worked on sooner than handed to a thread

_pool = ThreadPoolExecutor(2, 'plane')      # starts its threads when they are first needed


def both(work: Callable, *arguments, pixels: int) -> tuple:
    """What `work` gives for plane A and for plane B; each of `arguments` holds one of each. pixels: how many it works on, in all."""
    return tuple((_pool.map if pixels > FEW else map)(work, *arguments))
