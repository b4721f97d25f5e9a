"""Arrays that another process sees without a copy. They lie in memory of no name (memfd_create(2)), so that nothing of
it is left once both have ended, however they did."""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

ALIGNED = 64            # bytes: a cache line


@dataclass(frozen=True)
class Place:
    """Where an array lies, and what it is; small enough for a pipe."""

    offset: int         # bytes
    shape: tuple[int, ...]
    dtype: str

    @property
    def stop(self) -> int:
        """The first byte behind it."""
        return self.offset + int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize

    def inside(self, memory) -> np.ndarray:
        """The array, a view of `memory`."""
        return np.ndarray(self.shape, self.dtype, memory, self.offset)


class SharedArrays:
    """The side that writes. Raises OSError where the system has no such memory left."""

    def __init__(self):
        self.fd = os.memfd_create('fluoro_shape')
        self._memory, self._size = None, 0

    def put(self, arrays: Sequence[np.ndarray]) -> tuple[Any, ...]:
        """Write arrays over those before, which nobody may be reading any more; where they lie now. There is as much
        memory as the most of them needed."""
        places, stop = [], 0
        for array in arrays:
            places.append(Place(-(-stop // ALIGNED) * ALIGNED, array.shape, array.dtype.str))
            stop = places[-1].stop
        if stop > self._size:
            os.ftruncate(self.fd, stop)
            self._memory, self._size = mmap.mmap(self.fd, stop), stop
        for place, array in zip(places, arrays):
            np.copyto(place.inside(self._memory), array)
        return tuple(places)

    def close(self) -> None:
        """It goes once the other side has closed it, too."""
        self._memory = None
        os.close(self.fd)


class SeenArrays:
    """The side that reads: `fd` is that of the other's SharedArrays."""

    def __init__(self, fd: int):
        self._fd, self._size = fd, 0
        self._memory: bytes | mmap.mmap = b''

    def at(self, places: Sequence) -> tuple[Any, ...]:
        """The arrays there, as they are until the other side writes again; read-only."""
        if max((place.stop for place in places), default=0) > self._size:
            self._size = os.fstat(self._fd).st_size
            self._memory = mmap.mmap(self._fd, self._size, access=mmap.ACCESS_READ)
        return tuple(place.inside(self._memory) for place in places)
