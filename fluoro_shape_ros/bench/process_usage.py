"""What another process uses, from Linux's /proc (proc(5))."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Usage:
    """Of a process up to now."""

    cpu_s: float        # all its threads, user and system
    resident: int       # bytes
    peak: int           # bytes resident at most


def usage(pid: int) -> Usage:
    """Raises OSError where there is no such process (any more), or no /proc."""
    folder = Path('/proc') / str(pid)
    # the command's name in parentheses may hold anything; what follows it begins with field 3
    fields = (folder / 'stat').read_text().rpartition(')')[2].split()
    memory = dict(line.split(':', 1) for line in (folder / 'status').read_text().splitlines())
    if 'VmRSS' not in memory:
        raise ProcessLookupError(f'process {pid} has ended')
    resident, peak = (int(memory[name].split()[0]) * 1024 for name in ('VmRSS', 'VmHWM'))
    return Usage((int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK'), resident, peak)
