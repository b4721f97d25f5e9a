"""When the images of both planes were taken, as far as anything tells, and how many pairs that makes."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

from ..cli import ToolError
from ..config import Config
from ..ros.pairing import PLANES, Pairer

RATE_HZ = 15.0              # where nothing tells
FIRST_STAMP_NS = 10**9      # a stamp of zero says nothing about time


def stamps_of(counts: list[int], times: list[list[int] | None], rate_hz: float | None = None,
              path: str | None = None) -> tuple[list[list[int]], list[str]]:
    """Stamps in ns of so many images of both planes and a line where they are a guess: from the file at `path`, at a
    rate, or the `times` that their files say.

    Raises ToolError.
    """
    if path:
        stamps = read_stamps(path)
        for wrong in (n for n in counts if n != len(stamps)):
            raise ToolError(f'{path} has {len(stamps)} stamps for {wrong} pairs')
        return [stamps, stamps], []
    if rate_hz is None and all(times):
        return times, []
    told = [rate for rate in map(mean_rate, filter(None, times)) if rate]
    if rate_hz is not None or max(counts) == 1:
        notes = []
    elif told:
        silent = times.index(None)
        notes = [f'plane {PLANES[silent].upper()} does not tell its rate: '
                 f'it is taken for that of plane {PLANES[1 - silent].upper()}, {told[0]:.4g}/s; --rate says it']
    else:
        notes = [f'no file tells the rate: {RATE_HZ:g} images/s are a guess; --rate or --stamps says it']
    return [even_stamps(rate_hz or (told[0] if told else RATE_HZ), n) if rate_hz or t is None else t
            for n, t in zip(counts, times)], notes


def mean_rate(stamps_ns: list[int]) -> float | None:
    """Images per second; None of fewer than two."""
    return (len(stamps_ns) - 1) * 1e9 / (stamps_ns[-1] - stamps_ns[0]) if len(stamps_ns) > 1 else None


def count_pairs(stamps_ns: list[list[int]]) -> tuple[int, list[str]]:
    """How many pairs a node with the default sync_slop makes of the images of both planes, and a line where that is not
    all of them."""
    slop_ns = round(Config().input.sync_slop * 1e9)
    pairer = Pairer(slop_ns)
    for stamp, plane in sorted((stamp, plane) for plane, stamps in zip(PLANES, stamps_ns) for stamp in stamps):
        pairer.add(plane, stamp, None)
    pairs = pairer.counts.pairs
    if all(len(stamps) == pairs for stamps in stamps_ns):
        return pairs, []
    planes = (f'plane {p.upper()} has {len(stamps)} images'
              + (f' at {rate:.4g}/s' if (rate := mean_rate(stamps)) else '') for p, stamps in zip(PLANES, stamps_ns))
    return pairs, [f'{" and ".join(planes)}: {sum(map(len, stamps_ns)) - 2 * pairs} have no partner within '
                   f'{slop_ns / 1e6:g} ms']


def read_stamps(path: str) -> list[int]:
    """Stamps in ns from a text file with seconds, one a line. Raises ToolError."""
    stamps = []
    for number, line in enumerate(Path(path).read_text(errors='replace').split('\n'), 1):
        if not line.strip():
            continue
        try:
            stamp = int(Decimal(line.strip()) * 10**9)      # a double has no room for the nanoseconds of today's date
        except (InvalidOperation, ValueError, OverflowError):
            raise ToolError(f'{path}, line {number}: "{line.strip()[:40]}" is no time in seconds') from None
        if not (stamps[-1] if stamps else 0) < stamp < 2**31 * 10**9:
            raise ToolError(f'{path}, line {number}: {line.strip()} s: stamps must be positive and increase')
        stamps.append(stamp)
    return stamps


def even_stamps(rate_hz: float, count: int) -> list[int]:
    """`count` stamps in ns at `rate_hz`."""
    return [FIRST_STAMP_NS + round(k * 1e9 / rate_hz) for k in range(count)]
