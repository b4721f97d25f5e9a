"""How late an answer is on real topics: the node as a process, and this one as the X-ray system and the controller."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from .. import cli
from ..demo.main import child
from ..sim import scenes
from ..sim.carm import CArm, biplane
from .process_usage import usage
from .speed import FIELD

SPEED = 0.02            # m/s, of the fastest point of the device
MOMENT = 1.0            # s of the device's motion at which they begin: it starts from rest
STARTUP_S = 60.0        # for the node's first result
SETTLE_S = 1.0          # of streaming before the measurement begins
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')


@dataclass(frozen=True)
class Row:
    """What was measured at one rate; times in s, memory in bytes."""

    rate: float                 # pairs a second that were asked for
    seconds: float              # how long
    sent: int
    answered: int
    refused: int                # by the node, with a reason
    dropped: int                # overtaken by a newer pair, as the node counts it
    latency: list[float]        # handing over the second image to having its Path, of each answered pair
    compute: list[float]        # of these: what the reconstruction itself took
    services: list[float]       # that services and parameters took to answer meanwhile
    reports: float              # longest time between two diagnostics
    cores: float                # that the node kept busy
    resident: int
    peak: int
    first_result: float         # from the start of the node's process
    tip_errors: list[float]     # m

    @property
    def lost(self) -> int:
        """Pairs that nobody knows anything of."""
        return self.sent - self.answered - self.refused - self.dropped

    @property
    def overhead(self) -> np.ndarray:
        """(answered,) latency less compute."""
        return np.array(self.latency) - self.compute


def choose_profile(as_shipped: bool) -> None:
    """The Fast DDS profile of this process and its children: the package's unless the user has one, or none. Before
    anything uses ROS."""
    if as_shipped:
        for name in PROFILES:
            os.environ.pop(name, None)
        return
    from ..sim.publisher import use_large_image_profile
    use_large_image_profile()


def moving_scenes(size: int, rate: float, seed: int, count: int) -> list[scenes.Scene]:
    """`count` successive pairs, `rate` a second, of a device whose fastest point moves at about SPEED in front of
    anatomy."""
    views = biplane(arm=CArm(pixel_size_iso=FIELD / size, width=size, height=size))
    run = scenes.xray_run(seed, views=views, entering=True)
    dt = 0.01
    there, then = (run.backbone(t)[::50] for t in (MOMENT, MOMENT + dt))
    n = min(map(len, (there, then)))
    pace = SPEED / (np.linalg.norm(then[-n:] - there[-n:], axis=1).max() / dt)
    moments = tqdm(range(count), f'{rate:g}/s, rendering', unit='pair', disable=None, leave=False)
    return [run.scene(MOMENT + pace * k / rate, k) for k in moments]


@contextlib.contextmanager
def timed_node(scene: scenes.Scene, folder: Path,
               parameters: dict[str, object] | None = None) -> Iterator[subprocess.Popen]:
    """The node as a process that knows what a user knows of the scene; it logs into `folder`/node.log, and laps into
    `folder`/laps."""
    given = {'robot_radius': float(scene.radius), 'base_position': [round(float(x), 6) for x in scene.base_position],
             'reference_frame': scene.frame.frame_id, **(parameters or {})}
    words = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
    with child(['-m', 'fluoro_shape_ros.bench.timed_node', str(folder / 'laps'), '--ros-args', *words],
               folder / 'node.log') as process:
        yield process


def first_result(probe, rate: float, process: subprocess.Popen, folder: Path, since: float) -> float:
    """Seconds from `since` (time.monotonic) to the first Path. Raises ToolError, with the node's last words, where none
    comes."""
    gone = lambda: process.poll() is not None      # noqa: E731
    probe.until(lambda: probe.connected() or gone(), STARTUP_S)
    probe.stream(rate, STARTUP_S, stop=lambda: probe.answered or gone())
    if not probe.answered:
        log = (folder / 'node.log').read_text(errors='replace').strip().splitlines()
        raise cli.ToolError(f'the node gave no result within {STARTUP_S:.0f} '
                            f's{f", its last words: {log[-1]}" if log else ""}')
    return min(probe.answered.values()) - since


def measure(rate: float, seconds: float, pairs: list[scenes.Scene], tracking: bool = True) -> Row:
    """Stream `rate` of the pairs a second, forth and back, to a node of its own for so many seconds. Raises ToolError
    where it gives no result."""
    from .stopwatch import Probe  # needs ROS
    with tempfile.TemporaryDirectory() as name, Probe(pairs) as probe:
        folder, start = Path(name), time.monotonic()
        with timed_node(pairs[0], folder, {'tracking': str(tracking).lower()}) as process:
            first = first_result(probe, min(rate, 30.0), process, folder, start)
            probe.stream(rate, SETTLE_S, calls=True)
            counted = probe.counts()
            before, begin, begin_ns = usage(process.pid), time.monotonic(), time.time_ns()
            del probe.calls[:]
            probe.stream(rate, seconds, calls=True)
            after, end, end_ns = usage(process.pid), time.monotonic(), time.time_ns()
            counts = probe.counts()
            if not counts or process.poll() is not None:
                raise cli.ToolError(f'the node ended or fell silent at {rate:g} pairs/s')
        took = dict(line.split() for line in (folder / 'laps').read_text().splitlines())
    sent = [stamp for stamp in probe.sent if begin_ns <= stamp < end_ns]
    answered = [stamp for stamp in sent if stamp in probe.answered and str(stamp) in took]
    heard = [begin, *(t for t, _ in probe.reports if begin < t < end), end]
    return Row(rate, end - begin, len(sent), len(answered), counts['refused'] - counted['refused'],
               counts['dropped'] - counted['dropped'], [probe.answered[s] - probe.sent[s] for s in answered],
               [float(took[str(s)]) for s in answered], list(probe.calls),
               float(np.diff(heard).max()), (after.cpu_s - before.cpu_s) / (end - begin), after.resident, after.peak,
               first, [probe.tip_errors[s] for s in answered if s in probe.tip_errors])


def table(rows: list[Row], as_shipped: bool) -> str:
    """A line a rate for a terminal, and what the columns mean."""
    lines = [f'{"":>7s} {"pairs":^41s} | {"latency (ms)":^29s} | {"compute":^13s} | {"rest":^13s} | {"services":^13s} '
             f'| {"node":^28s} | tip',
             f'{"rate":>7s} {"sent/s":>6s} {"sent":>6s} {"answered":>8s} {"refused":>7s} {"dropped":>7s} {"lost":>4s} '
             f'| {"median":>7s} {"p95":>6s} {"p99":>6s} {"worst":>7s} | {"median":>6s} {"p95":>6s} | {"median":>6s} '
             f'{"p95":>6s} | {"p95":>6s} {"worst":>6s} | {"cores":>5s} {"MB":>5s} {"peak":>5s} {"first s":>7s} | mm']
    lines += [_line(row) for row in rows]
    profile = 'as shipped' if as_shipped else os.environ.get(PROFILES[0]) or os.environ.get(PROFILES[1]) or 'no profile'
    return '\n'.join([*lines, '', f"""\
latency   from handing over the second image of a pair to having its Path, not yet as Python objects;
          compute: the reconstruction's share of it; rest: the difference, pair by pair
dropped   overtaken by a newer pair, as the node counts it; lost: known to nobody
services  ms that ~/clear_mask and set_parameters, called four times a second, took to answer meanwhile
node      cores it kept busy, resident memory at the end and at most, s from its start to the first result
tip       median error of the answers
Fast DDS  {profile}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"""])


def _line(r: Row) -> str:
    pairs = (f'{r.rate:7g} {r.sent / r.seconds:6.1f} {r.sent:6d} {r.answered:8d} {r.refused:7d} {r.dropped:7d} '
             f'{r.lost:4d}')
    node = f'{r.cores:5.2f} {r.resident / 1e6:5.0f} {r.peak / 1e6:5.0f} {r.first_result:7.2f}'
    tip = f'{np.median(r.tip_errors) * 1e3:.2f}' if r.tip_errors else '-'
    return (f'{pairs} | {_ms(r.latency, 50):>7s} {_ms(r.latency, 95):>6s} {_ms(r.latency, 99):>6s} '
            f'{_ms(r.latency, 100):>7s} | {_ms(r.compute, 50):>6s} '
            f'{_ms(r.compute, 95):>6s} | {_ms(r.overhead, 50):>6s} {_ms(r.overhead, 95):>6s} | '
            f'{_ms(r.services, 95):>6s} {_ms(r.services, 100):>6s} | {node} | {tip}')


def _ms(seconds, percentile: float) -> str:
    return f'{np.percentile(seconds, percentile) * 1e3:.1f}' if len(seconds) else '-'


def plain(row: Row) -> dict:
    """For JSON."""
    return {**dataclasses.asdict(row), 'lost': row.lost}
