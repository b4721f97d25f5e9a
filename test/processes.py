"""The processes behind a node, as Linux has them (proc(5))."""

import contextlib
import os
from pathlib import Path


def reconstructing_for(pid):
    """The processes that reconstruct for process `pid`."""
    found = []
    for tasks in Path(f'/proc/{pid}/task').glob('*/children'):
        for child in tasks.read_text().split():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):    # it has just ended
                if 'reconstruction_child' in Path(f'/proc/{child}/cmdline').read_text():
                    found.append(int(child))
    return found


def gone(pid):
    """Whether a process has ended, with all its threads; that nobody has asked for its exit code yet does not count."""
    try:
        return (Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] == 'Z'
                and os.listdir(f'/proc/{pid}/task') == [str(pid)])
    except (FileNotFoundError, ProcessLookupError):
        return True
