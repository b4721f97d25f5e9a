"""What another process and its children use, from Linux's /proc (proc(5))."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Usage:
    """Of processes up to now."""

    cpu_s: float        # all their threads, user and system
    resident: int       # bytes
    peak: int           # bytes resident at most


def usage(pid: int) -> Usage:
    """Of a process and its children; memory that they share counts for each. Raises OSError where there is no such
    process (any more), or no /proc."""
    uses = [_alone(pid), *_of_children(pid)]
    return Usage(sum(u.cpu_s for u in uses), sum(u.resident for u in uses), sum(u.peak for u in uses))


def _of_children(pid: int) -> list[Usage]:
    found = []
    for listed in Path('/proc', str(pid), 'task').glob('*/children'):
        for child in listed.read_text().split():
            with contextlib.suppress(OSError):      # it has just ended
                found.append(usage(int(child)))
    return found


def _alone(pid: int) -> Usage:
    folder = Path('/proc') / str(pid)
    # the command's name in parentheses may hold anything; what follows it begins with field 3
    fields = (folder / 'stat').read_text().rpartition(')')[2].split()
    memory = dict(line.split(':', 1) for line in (folder / 'status').read_text().splitlines())
    if 'VmRSS' not in memory:
        raise ProcessLookupError(f'process {pid} has ended')
    resident, peak = (int(memory[name].split()[0]) * 1024 for name in ('VmRSS', 'VmHWM'))
    return Usage((int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK'), resident, peak)
