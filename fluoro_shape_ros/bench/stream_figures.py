"""What the pairs of streams come to, in order: how soon a device is found and found again, how long it is missed, and
jumps that it did not make."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .score import SILENT_MEAN, SILENT_TIP, WITHIN_MEAN, WITHIN_TIP, Answer

JUMP = 2e-3         # m
LEGEND = f"""\
shown     pairs of which both planes show the device; answered, right: of these
right     mean <= {WITHIN_MEAN * 1e3:g} mm or 1 px there, and tip <= {WITHIN_TIP * 1e3:g} mm or 3 px
silent    published, yet mean > {SILENT_MEAN * 1e3:g} mm or tip > {SILENT_TIP * 1e3:g} mm, or a plane was dark
found     streams with a right pair; then: of their pairs from the first right one on, those that are right;
          gap: most pairs shown in succession without an answer
back      times that a device which had been found came into sight again, and was found again;
          in: pairs that took at most, the right one included
jumps     from one answer to the next the tip moves by {JUMP * 1e3:g} mm otherwise than the true one,
          or the backbone strays from the true one by as much more or less
ms        wall time of a pair"""


@dataclass(frozen=True, eq=False)
class Pair:
    """What was said of a pair of a stream."""

    answer: Answer                          # its `device` is whether both images show one
    seconds: float                          # wall time
    tip_off: np.ndarray | None = None       # (3,) m, from the true tip to the published one; None: there is none
    stray: float = math.nan                 # m, of the published point that lies farthest from the true curve


def found(pairs: Sequence[Pair]) -> int | None:
    """Index of the first pair that is right; None where none is."""
    return next((k for k, p in enumerate(pairs) if p.answer.right), None)


def gap(pairs: Sequence[Pair]) -> int:
    """Most pairs in succession that show the device and have no answer."""
    longest = run = 0
    for p in pairs:
        run = run + 1 if p.answer.device and not p.answer.published else 0
        longest = max(longest, run)
    return longest


def recoveries(pairs: Sequence[Pair]) -> list[int | None]:
    """Of each time that a device comes into sight again which had been found: pairs up to the first right one, with it;
    None where it goes or ends without."""
    first, taken = found(pairs), []
    for k in range(1, len(pairs)):
        if first is not None and first < k and pairs[k].answer.device and not pairs[k - 1].answer.device:
            seen = next((n for n, p in enumerate(pairs[k:]) if not p.answer.device), len(pairs) - k)
            again = found(pairs[k:k + seen])
            taken.append(None if again is None else again + 1)
    return taken


def jumps(pairs: Sequence[Pair]) -> int:
    """How often what is published moves otherwise than the device, by JUMP, from one answer to the next."""
    said = [p for p in pairs if p.tip_off is not None]
    return sum(bool(np.linalg.norm(b.tip_off - a.tip_off) > JUMP or abs(b.stray - a.stray) > JUMP)
               for a, b in zip(said, said[1:]))


@dataclass(frozen=True)
class Row:
    """What some streams come to; counts, and s."""

    streams: int
    pairs: int
    shown: int
    answered: int               # of those shown
    right: int
    silent: int                 # of all
    found: int                  # streams
    since: int                  # pairs shown from the first right one on ...
    right_since: int            # ... and those of them that are right
    gap: int
    back: int                   # times that a device came into sight again ...
    again: int                  # ... and was found again ...
    pairs_to_recover: int       # ... and at most so many pairs later; 0: never
    jumps: int
    median: float
    p95: float
    p99: float
    worst: float
    rejections: dict[str, int]  # of pairs shown, by reason, most frequent first


def row(streams: Sequence[Sequence[Pair]]) -> Row:
    """What these streams come to."""
    everything = [p for pairs in streams for p in pairs]
    shown = [p.answer for p in everything if p.answer.device]
    since = [p.answer for pairs in streams if (k := found(pairs)) is not None for p in pairs[k:] if p.answer.device]
    taken = [n for pairs in streams for n in recoveries(pairs)]
    median, p95, p99, worst = map(float, np.percentile([p.seconds for p in everything], [50, 95, 99, 100]))
    return Row(len(streams), len(everything), len(shown), sum(a.published for a in shown), sum(a.right for a in shown),
               sum(p.answer.silent_failure for p in everything), sum(found(pairs) is not None for pairs in streams),
               len(since), sum(a.right for a in since), max(map(gap, streams)), len(taken),
               sum(n is not None for n in taken), max((n for n in taken if n), default=0), sum(map(jumps, streams)),
               median, p95, p99, worst, dict(Counter(a.outcome.value for a in shown if not a.published).most_common()))


def rows(streams: Iterable[tuple[str, Sequence[Pair]]]) -> dict[str, Row]:
    """A row a kind of (kind, pairs), in their order, and where there are several `total`."""
    by_kind: dict[str, list] = {}
    for kind, pairs in streams:
        by_kind.setdefault(kind, []).append(pairs)
    return {kind: row(of_kind)
            for kind, of_kind in (by_kind | ({'total': sum(by_kind.values(), [])} if len(by_kind) > 1 else {})).items()}


def table(found_rows: dict[str, Row]) -> str:
    """A line a row for a terminal, and what the columns mean."""
    lines = [f'{"":12s} {"streams":>7s} {"pairs":>6s} {"shown":>6s} {"answered":>8s} {"right":>7s} {"silent":>6s} '
             f'{"found":>5s} {"then":>7s} {"gap":>4s} {"back":>7s} {"in":>3s} '
             f'{"jumps":>5s} | {"ms median":>9s} {"p95":>6s} {"p99":>6s} {"worst":>6s} | not answered']
    return '\n'.join([*lines, *(_line(kind, r) for kind, r in found_rows.items()), '', LEGEND])


def _line(kind: str, r: Row) -> str:
    back = f'{r.again} of {r.back}' if r.back else '-'
    times = ' '.join(f'{1e3 * s:{width}.0f}' for s, width in ((r.median, 9), (r.p95, 6), (r.p99, 6), (r.worst, 6)))
    reasons = ', '.join(f'{n} {reason}' for reason, n in r.rejections.items())
    return (f'{kind:12s} {r.streams:7d} {r.pairs:6d} {r.shown:6d} {_share(r.answered, r.shown):>8s} '
            f'{_share(r.right, r.shown):>7s} {r.silent:6d} {r.found:5d} {_share(r.right_since, r.since):>7s} '
            f'{r.gap:4d} {back:>7s} {r.pairs_to_recover or "-":>3} {r.jumps:5d} | {times} | {reasons}').rstrip()


def _share(part: int, whole: int) -> str:
    """Per cent, to a tenth; '-' of nothing."""
    return f'{100 * part / whole:.1f} %' if whole else '-'
