"""What stamps decide, continued: which camera holds for an image, and which pairs wait for theirs."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

from .pairing import JUMP_NS

BUFFER = 8              # changes of a plane's camera that are known, pairs that wait for their cameras
RECENT = 64             # stamps of cameras that are known
PATIENCE_S = 4.0        # for a camera info that should come with its image: what the middleware lost, it sends again
                        # within 3 s
LOSSY_PATIENCE_S = 0.2  # the same where it sends nothing again


class CameraBook:
    """Which camera holds for an image of one plane: the newest one stamped at or before it.

    Only changes are kept. An image older than every camera takes the oldest known one.
    """

    def __init__(self):
        self._stamps, self._cameras = [], []    # of the changes, by stamp
        self._newest = None                     # stamp of the last camera, changed or not
        self._heard = deque(maxlen=RECENT)      # stamps of the last cameras
        self._asked = deque(maxlen=BUFFER)      # stamps of images that no camera has passed yet
        self._own = deque(maxlen=4)             # of the last images, whether each had a camera stamped alike
        self._given_up = False

    def add(self, stamp_ns: int, camera) -> None:
        """Take in a camera (anything that can be compared) that holds from `stamp_ns` on."""
        if self._newest is not None and stamp_ns < self._newest - JUMP_NS:
            self.rewind(stamp_ns)
        self._newest = max(stamp_ns, self._newest or 0)
        self._heard.append(stamp_ns)
        self._settle()
        k = bisect_right(self._stamps, stamp_ns)
        if k == 0 or self._cameras[k - 1] != camera:
            self._stamps.insert(k, stamp_ns)
            self._cameras.insert(k, camera)
            del self._stamps[:-BUFFER], self._cameras[:-BUFFER]

    def at(self, stamp_ns: int):
        """The camera that holds for an image, or None where none is known."""
        if not self._cameras:
            return None
        return self._cameras[max(bisect_right(self._stamps, stamp_ns) - 1, 0)]

    @property
    def newest(self):
        """The last camera, or None."""
        return self._cameras[-1] if self._cameras else None

    def awaits(self, stamp_ns: int) -> bool:
        """Whether an image came before its camera: there is none at all, or most come with their images and this one's
        is still on its way."""
        if stamp_ns not in self._asked:
            self._asked.append(stamp_ns)
            self._settle()
        if not self._cameras:
            return not self._given_up
        return 2 * sum(self._own) > len(self._own) and self._newest < stamp_ns

    def give_up(self) -> None:
        """Cameras come no longer with the images: stop waiting for them, until they do again."""
        self._own.clear()
        self._given_up = True

    def rewind(self, stamp_ns: int) -> None:
        """The stamps jumped back to `stamp_ns`: forget later changes. With nothing else left,
        the newest camera goes on.

        Cameras that are ahead by less than JUMP_NS have come from behind the jump already, before their images.
        """
        if self._newest is None or self._newest <= stamp_ns + JUMP_NS:
            return
        last = self._cameras[-1]
        k = bisect_right(self._stamps, stamp_ns)
        del self._stamps[k:], self._cameras[k:]
        if not self._cameras:
            self._stamps, self._cameras = [stamp_ns], [last]
        self._newest = stamp_ns - 1
        self._heard.clear()
        self._asked.clear()

    def _settle(self) -> None:
        """Decide for the images that a camera has passed by now whether they had one of their own."""
        passed = [s for s in self._asked if self._newest is not None and s <= self._newest]
        for stamp_ns in passed:
            self._asked.remove(stamp_ns)
            self._own.append(stamp_ns in self._heard)


@dataclass(frozen=True)
class Pair:
    """Two frames that belong together."""

    stamps: tuple[int, int]     # ns
    items: tuple[Any, Any]
    arrived: float              # s, when the second one came


class WaitingRoom:
    """Pairs whose cameras are still on their way; the newest one whose cameras are known goes first, and older ones
    never after it."""

    def __init__(self):
        self._pairs = deque(maxlen=BUFFER)
        self._since = None      # when the first one came that no other has overtaken

    def __len__(self) -> int:
        return len(self._pairs)

    def add(self, pair: Pair) -> int:
        """Take in a pair newer than all before; the number of pairs given up for it."""
        lost = len(self._pairs) == BUFFER
        self._pairs.append(pair)
        self._since = pair.arrived if self._since is None else self._since
        return int(lost)

    def clear(self) -> None:
        self._pairs.clear()
        self._since = None

    def take(self, books: tuple[CameraBook, CameraBook], now: float, lossy: bool = False) -> tuple[Pair | None, int]:
        """The newest pair whose cameras are known, and the number of older ones given up for it.

        After PATIENCE_S (LOSSY_PATIENCE_S where a lost camera info is `lossy`: lost for good) the newest pair goes
        without.
        """
        awaited = [[book.awaits(stamp) for book, stamp in zip(books, pair.stamps)] for pair in self._pairs]
        ready = [k for k, planes in enumerate(awaited) if not any(planes)]
        if not ready and self._pairs and now >= self._since + (LOSSY_PATIENCE_S if lossy else PATIENCE_S):
            for book, late in zip(books, awaited[-1]):
                if late:
                    book.give_up()
            ready = [len(self._pairs) - 1]
        if not ready:
            return None, 0
        older = [self._pairs.popleft() for _ in range(ready[-1] + 1)]
        self._since = self._pairs[0].arrived if self._pairs else None
        return older[-1], len(older) - 1
