"""Both planes at once: worth it for work on whole images, during which NumPy and OpenCV let go of the interpreter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_pool = ThreadPoolExecutor(2, 'plane')      # starts its threads when they are first needed


def both(work: Callable, *arguments) -> tuple:
    """What `work` gives for plane A and for plane B; each of `arguments` holds one of each."""
    return tuple(_pool.map(work, *arguments))
