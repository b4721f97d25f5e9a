"""Whether the node's memory grows: pair after pair on real topics, each sent when the one before is answered."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ..cli import ToolError
from ..sim.scenes import Scene
from .latency import first_result, timed_node
from .process_usage import usage

RATE = 30.0             # pairs a second, for which the motion is rendered
PATIENCE_S = 2.0        # for an answer: a refused pair gets none
WARM_UP = 0.1           # share of the pairs after which caches and pools are filled
SAMPLES = 200


@dataclass(frozen=True)
class Memory:
    """Of the node's process, bytes."""

    pairs: int
    answered: int
    seconds: float
    after: list[int]            # pairs answered or given up when a sample was taken
    resident: list[int]
    peak: int

    @property
    def growth(self) -> float:
        """Bytes gained from the end of warming up to the end of the run."""
        warm = int(len(self.resident) * WARM_UP)
        tail = max(1, len(self.resident) // 20)
        return float(np.median(self.resident[-tail:]) - np.median(self.resident[warm:warm + tail]))

    @property
    def slope(self) -> float:
        """Bytes a pair after warming up, by least squares."""
        warm = int(len(self.resident) * WARM_UP)
        return (float(np.polyfit(self.after[warm:], self.resident[warm:], 1)[0])
                if len(self.resident) - warm > 1 else 0.0)


def measure(pairs: int, scenes: list[Scene], everything: bool = False) -> Memory:
    """Let a node of its own answer so many pairs, `scenes` forth and back; `everything`: with a subscriber to all that
    it computes on demand too.

    Raises ToolError where the node gives no result, or ends.
    """
    from .stopwatch import Probe  # needs ROS
    with tempfile.TemporaryDirectory() as name, Probe(scenes) as probe, timed_node(scenes[0], Path(name)) as process:
        if everything:
            probe.listen_to_everything()
        first_result(probe, RATE, process, Path(name), time.monotonic())
        probe.sent.clear()
        probe.answered.clear()
        after, resident, start, answered = [], [], time.monotonic(), 0
        for k in tqdm(range(1, pairs + 1), unit='pair', disable=None, leave=False):
            stamp = probe.publish()
            answered += probe.until(lambda: stamp in probe.answered, PATIENCE_S)    # noqa: B023 (called at once)
            if process.poll() is not None:
                raise ToolError(f'the node ended after {k} pairs')
            if k % max(1, pairs // SAMPLES) == 0:
                after.append(k)
                resident.append(usage(process.pid).resident)
        return Memory(pairs, answered, time.monotonic() - start, after, resident, usage(process.pid).peak)


def report(m: Memory, size: int) -> str:
    """For a terminal."""
    mb = [f'{m.resident[round(share * (len(m.resident) - 1))] / 1e6:.1f}' for share in (0, WARM_UP, 0.25, 0.5, 0.75, 1)]
    return '\n'.join([
        f'{m.answered} of {m.pairs} pairs of {size} px answered in {m.seconds:.0f} s',
        f'resident MB at first, after 10 %, 25 %, 50 %, 75 % and all pairs: {", ".join(mb)}; '
        f'at most {m.peak / 1e6:.1f}',
        f'growth after the first 10 %: {m.growth / 1e6:+.2f} MB; slope {m.slope * 1e4 / 1e6:+.2f} MB in 10000 pairs'])
