"""fluoro_shape_node with a stopwatch: `timed_node FILE [ROS arguments]` writes a line `stamp_ns seconds` into FILE for each pair's reconstruction."""

from __future__ import annotations

import sys
import time

from .. import node
from ..method import pipeline


def main(argv: list[str]) -> int:
    """The node's exit code."""
    file, *rest = argv
    reconstruct = pipeline.reconstruct
    with open(file, 'w', buffering=1, encoding='ascii') as laps:
        def timed(frame, *arguments):
            start = time.perf_counter()
            result = reconstruct(frame, *arguments)
            laps.write(f'{frame.stamp_ns} {time.perf_counter() - start:.6f}\n')
            return result
        pipeline.reconstruct = timed    # before the node takes it from there
        return node.main(rest)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
