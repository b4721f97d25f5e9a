"""fluoro_shape_node with a stopwatch: `timed_node FILE [ROS arguments]` writes a line `stamp_ns seconds` into FILE for
each pair's reconstruction."""

from __future__ import annotations

import sys

from .. import node
from ..ros.reconstructor import Reconstructor


def main(argv: list[str]) -> int:
    """The node's exit code."""
    file, *rest = argv
    reconstruct = Reconstructor.__call__
    with open(file, 'w', buffering=1, encoding='ascii') as laps:
        def timed(self, frame, *arguments):
            result = reconstruct(self, frame, *arguments)
            laps.write(f'{frame.stamp_ns} {self.took_s:.6f}\n')
            return result
        Reconstructor.__call__ = timed      # type: ignore[method-assign]
        return node.main(rest)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
