"""Both planes at once: worth it for work on whole images, during which NumPy and OpenCV let go of the interpreter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

FEW = 2**19     # pixels of both planes that are worked on sooner than handed to a thread

_other = ThreadPoolExecutor(1, 'plane')     # its thread is started when it is first needed


def both(work: Callable, *arguments: Any, pixels: int) -> Any:
    """What `work` gives for plane A and for plane B; each of `arguments` holds one of each. pixels: how many it works
    on, in all."""
    *others, last = zip(*arguments)
    if pixels <= FEW:
        return (*(work(*o) for o in others), work(*last))
    handed = [_other.submit(work, *o) for o in others]
    own = work(*last)
    return (*(h.result() for h in handed), own)
