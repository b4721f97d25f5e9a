"""What stamps decide: which images make a pair."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field

PLANES = ('a', 'b')
JUMP_NS = 500_000_000   # farther back than this is no late frame: the stream has started anew (bag loop,
                        # simulator restart)
BUFFER = 8              # images a plane that wait for a partner
RECENT = 64             # stamps a plane among which a duplicate is known
LAST_NS = (2**31 - 1) * 10**9   # of builtin_interfaces/Time, whose seconds are an int32


@dataclass
class Counts:
    """What became of the frames: received = 2 pairs + unpaired + duplicates + unstamped + still waiting."""

    pairs: int = 0
    unpaired: int = 0       # given up: no partner within the slop, or overtaken by a newer pair
    out_of_order: int = 0   # older than a frame of the same plane before; counted beside what became of it
    duplicates: int = 0     # same plane, same stamp: the first one holds
    unstamped: int = 0      # a stamp of zero (or one that no Time can hold) says nothing about time and is never paired
    jumps: int = 0          # how often the stamps of a plane jumped back and everything waiting was forgotten


@dataclass
class _Plane:
    """What is known of one plane's stream since the last reset."""

    stamps: list[int] = field(default_factory=list)     # of the waiting frames, ascending
    items: list = field(default_factory=list)           # the waiting frames
    recent: deque = field(default_factory=lambda: deque(maxlen=RECENT))
    steps: deque = field(default_factory=lambda: deque(maxlen=5))   # ns, between the newest frames
    newest: int | None = None
    floor: int = 0                                      # stamp of the frame paired last: older ones come too late

    def insert(self, stamp: int, item) -> None:
        k = bisect_left(self.stamps, stamp)
        self.stamps.insert(k, stamp)
        self.items.insert(k, item)

    def advance(self, stamp: int) -> None:
        if self.newest is not None:
            self.steps.append(stamp - self.newest)
        self.newest = stamp

    def drop(self, count: int) -> int:
        """Forget the `count` oldest waiting frames; how many those were."""
        del self.stamps[:count], self.items[:count]
        return count

    def nearest(self, stamp: int) -> int:
        """Index of the waiting frame nearest to `stamp`, the newer of two equally near ones."""
        return min(range(len(self.stamps)), key=lambda k: (abs(self.stamps[k] - stamp), -k))

    def can_bring(self, before: int) -> bool:
        """Whether this plane, going on at the pace seen so far, may still send a frame stamped earlier than
        `before`."""
        return bool(self.steps) and self.newest + min(self.steps) < before


class Pairer:
    """Pairs frames whose stamps differ by at most `slop_ns`, each with its nearest partner, never an older pair after a
    newer one."""

    def __init__(self, slop_ns: int):
        self.slop_ns = slop_ns
        self.counts = Counts()
        self._planes = {p: _Plane() for p in PLANES}

    def add(self, plane: str, stamp_ns: int, item) -> tuple | None:
        """Take in a frame of plane 'a' or 'b'; the newest complete pair (stamp_a_ns, item_a, item_b), or None.

        A stamp more than JUMP_NS behind its plane's newest one resets the pairer and counts as a jump.
        """
        me, counts = self._planes[plane], self.counts
        if not 0 < stamp_ns <= LAST_NS:
            counts.unstamped += 1
            return None
        if me.newest is not None and stamp_ns < me.newest - JUMP_NS:
            counts.jumps += 1
            self.reset()
            me = self._planes[plane]
        if stamp_ns in me.recent:
            counts.duplicates += 1
            return None
        me.recent.append(stamp_ns)
        if me.newest is None or stamp_ns > me.newest:
            me.advance(stamp_ns)
        else:
            counts.out_of_order += 1
        if stamp_ns <= me.floor:
            counts.unpaired += 1
            return None
        me.insert(stamp_ns, item)
        pair = self._newest_pair()
        counts.unpaired += me.drop(max(len(me.stamps) - BUFFER, 0))
        return pair

    def reset(self) -> None:
        """Forget everything that waits; the counts go on."""
        self.counts.unpaired += self.waiting
        self._planes = {p: _Plane() for p in PLANES}

    @property
    def waiting(self) -> int:
        """Number of frames that wait for a partner."""
        return sum(len(p.stamps) for p in self._planes.values())

    @property
    def gap_ns(self) -> int | None:
        """How far plane B's newest stamp is ahead of plane A's; None before both have sent."""
        a, b = self._planes.values()
        return None if a.newest is None or b.newest is None else b.newest - a.newest

    def _newest_pair(self) -> tuple | None:
        a, b = self._planes.values()
        if not a.stamps or not b.stamps:
            return None
        for i in reversed(range(len(a.stamps))):
            j = b.nearest(a.stamps[i])
            if a.nearest(b.stamps[j]) == i and self._settled(a.stamps[i], b.stamps[j]):
                return self._take(i, j)
        return None

    def _settled(self, stamp_a: int, stamp_b: int) -> bool:
        """Whether two frames, nearest to each other of all that wait, are near enough and nothing nearer is to be
        expected."""
        a, b = self._planes.values()
        gap = abs(stamp_a - stamp_b)
        lagging, later = (a, stamp_b) if stamp_a < stamp_b else (b, stamp_a)
        return gap <= self.slop_ns and not (gap and lagging.can_bring(later + gap))

    def _take(self, i: int, j: int) -> tuple:
        """The pair of waiting frames i and j; what is older than them will never be needed."""
        a, b = self._planes.values()
        pair = a.stamps[i], a.items[i], b.items[j]
        a.floor, b.floor = a.stamps[i], b.stamps[j]
        self.counts.pairs += 1
        self.counts.unpaired += a.drop(i + 1) + b.drop(j + 1) - 2
        return pair
