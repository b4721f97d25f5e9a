"""The command `streams`: seeded runs of fluoroscopy through the pipeline, pair after pair, as the node would answer
them."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ..cli import ToolError, count, natural
from ..config import Config
from ..data import Frame
from ..geometry.curve import distance_to
from ..jobs import in_order
from ..method.pipeline import reconstruct
from ..overlay import GOOD, REJECTED, TIP
from ..ros.worker import Job, Memory
from ..sim import ct
from ..sim.streams import KINDS, Moment, Stream, draw
from . import sheets, stream_figures
from .case import Case
from .score import PICTURES, answer_of
from .stream_figures import Pair
from .variety import LIMITS, verdict


@dataclass(frozen=True)
class Task:
    """A stream to try; small, so that it travels to another process."""

    seed: int
    kind: str
    pairs: int
    ct: Path | None = None
    time_budget: float = 0.0    # s; 0: no limit
    pictures: int = 0           # so many thumbnails, evenly, of the pairs ...
    picture: str = 'all'        # ... that fit one of PICTURES


@dataclass(frozen=True, eq=False)
class Trial:
    """What came of a task."""

    task: Task
    said: str                   # what the seed has drawn
    pairs: list[Pair]
    thumbnails: dict[int, np.ndarray] = field(default_factory=dict)     # by index of the pair


def attempt(task: Task) -> Trial:
    """Draw the stream of a task and answer its pairs in their order. Raises ToolError where it can't be drawn."""
    try:
        stream = draw(task.seed, task.kind, ct.load_ct(task.ct) if task.ct else None)
    except ValueError as error:
        raise ToolError(f'streams, seed {task.seed}: {error}') from error
    memory, config = Memory(), Config.from_values(robot_radius=stream.run.radius)
    _take_mask(stream, memory, config.input.mask_frames)
    pairs, thumbnails = [], {}
    for k, moment in enumerate(stream.pairs(task.pairs)):
        if k == 0:
            config = config.replace(base_position=moment.scene.base_position.tolist())
        pairs.append(answered(moment, config, memory, task.time_budget, stream))
        if task.pictures and PICTURES[task.picture](pairs[-1].answer):
            thumbnails[k] = sheets.thumbnail(moment.scene.frame.images)
    kept = [list(thumbnails)[round(i)]
            for i in np.linspace(0, len(thumbnails) - 1, min(task.pictures, len(thumbnails)))]
    return Trial(task, stream.said(), pairs, {k: thumbnails[k] for k in kept})


def answered(moment: Moment, config: Config, memory: Memory, time_budget: float, stream: Stream) -> Pair:
    """A pair through the pipeline and into the memory as the node's worker does it; with a `time_budget` in s it has
    until then."""
    frame = moment.scene.frame
    begin, begin_cpu = time.monotonic(), time.process_time()
    job = Job(frame.stamp_ns, frame.images, (None, None), config, memory.generation, begin)
    result = reconstruct(frame, config, memory.prior(job, frame, _window(frame)),
                         begin + time_budget if time_budget else None)
    memory.remember(job, frame, result)
    seconds, cpu_s = time.monotonic() - begin, time.process_time() - begin_cpu
    answer = dataclasses.replace(answer_of(Case(moment.scene, note=stream.said(), kind=stream.kind), result,
                                           moment.shown), cpu_s=cpu_s)
    if result.shape is None:
        return Pair(answer, seconds)
    return Pair(answer, seconds, result.shape.tip - moment.whole[-1],
                float(distance_to(result.shape.points, moment.whole).max()))


def _take_mask(stream: Stream, memory: Memory, frames: int) -> None:
    memory.capture_mask(frames)
    for frame in stream.mask(frames):
        memory.take_for_mask(frame, _window(frame))
    memory.finish_mask()


def _window(frame: Frame) -> tuple:
    """What the images of a stream have in common."""
    return tuple((image.shape, image.dtype) for image in frame.images)


# ---- the command


def add(commands) -> None:
    """The command's arguments."""
    text = 'runs of fluoroscopy, pair after pair: found, followed, lost and found again'
    epilog = 'kinds, in turn by seed:\n' + '\n'.join(f'  {name:12s} {of_kind}' for name, of_kind in KINDS.items())
    command = commands.add_parser('streams', help=text, description=f'{text[0].upper()}{text[1:]}.', epilog=epilog,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument('--streams', type=count, default=len(KINDS), metavar='N', help=f'(default: {len(KINDS)})')
    command.add_argument('--pairs', type=count, default=60, metavar='N', help='of each (default: 60)')
    command.add_argument('--kinds', nargs='+', choices=list(KINDS), default=list(KINDS), metavar='KIND',
                         help='(default: all)')
    command.add_argument('--first-seed', type=natural, default=0, metavar='SEED',
                         help='seeds count up from here (default: 0)')
    command.add_argument('--ct', type=Path, metavar='FILE', help='instead of drawn anatomy: a folder with one DICOM '
                                                                 'series, or NPZ with hu (z, y, x) and spacing_m')
    command.add_argument('--time-budget', type=_budget, default=0.0, metavar='S',
                         help='how long a pair may take, as the node\'s parameter of this name; '
                         '0: no limit, and the same answers on any machine (default: 0)')
    command.add_argument('--jobs', type=count, default=2, metavar='N', help='processes of one thread each (default: 2)')
    command.add_argument('--json', type=Path, metavar='FILE', help='write the rows and every pair there, in m and s')
    command.add_argument('--pictures', type=natural, default=0, metavar='N',
                         help='contact sheets of N pairs of each stream (default: 0)')
    command.add_argument('--pictures-of', choices=PICTURES, default='all',
                         help='of those that were answered, refused or wrong (default: all)')
    command.add_argument('--sheets', type=Path, default=Path('sheets'), metavar='DIR',
                         help='where they go (default: sheets)')
    command.set_defaults(body=_body)


def _budget(text: str) -> float:
    if not 0 <= (seconds := float(text)) <= 60:
        raise argparse.ArgumentTypeError(f'{text} does not lie in 0 to 60')
    return seconds


def _body(args, parser: argparse.ArgumentParser) -> int:
    """Try all streams, print the table, write the files and sheets."""
    if args.json and not args.json.absolute().parent.is_dir():
        raise ToolError(f'{args.json}: there is no such folder')
    if args.ct:
        try:
            ct.load_ct(args.ct)
        except ct.CtError as error:
            raise ToolError(str(error)) from error
    if args.pictures:
        args.sheets.mkdir(parents=True, exist_ok=True)
    kinds = list(dict.fromkeys(args.kinds))
    tasks = [Task(seed, kinds[seed % len(kinds)], args.pairs, args.ct and args.ct.absolute(), args.time_budget,
                  args.pictures, args.pictures_of)
             for seed in range(args.first_seed, args.first_seed + args.streams)]
    trials = sorted(tqdm(in_order(attempt, tasks, args.jobs), total=len(tasks), unit='stream', disable=None),
                    key=lambda t: kinds.index(t.task.kind))
    rows = stream_figures.rows((t.task.kind, t.pairs) for t in trials)
    print(stream_figures.table(rows))
    print(f'{"budget":9s} {f"{args.time_budget:g} s a pair" if args.time_budget else "none"}; {os.cpu_count()} cores, '
          f'load {os.getloadavg()[0]:.1f}')
    if args.json:
        given = {'command': args.command, 'first_seed': args.first_seed, 'ct': bool(args.ct),
                 'time_budget': args.time_budget}
        args.json.write_text(json.dumps({**given, 'limits': LIMITS | {'jump_m': stream_figures.JUMP},
                                         'rows': {kind: dataclasses.asdict(r) for kind, r in rows.items()},
                                         'streams': [plain(t) for t in trials]}, indent=1) + '\n')
    if args.pictures:
        write_sheets(trials, args.sheets)
    return 0


def write_sheets(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Contact sheets of each stream's thumbnails. Raises OSError."""
    return [file for t in trials for file in sheets.write(folder, f'{t.task.kind}_{t.task.seed}',
                                                          [_cell(t, k) for k in t.thumbnails])]


def _cell(trial: Trial, k: int) -> sheets.Cell:
    a = trial.pairs[k].answer
    errors = f': mean {a.errors.mean * 1e3:.2f}, tip {a.errors.tip * 1e3:.2f} mm' if a.errors else ''
    colour = TIP if a.silent_failure else GOOD if a.right or not a.device else REJECTED
    return sheets.Cell(trial.thumbnails[k], f'{trial.task.kind} {trial.task.seed}, pair {k}', trial.said,
                       verdict(a) + errors, colour)


def plain(trial: Trial) -> dict:
    """A stream for JSON, in m and s; what is not known is null."""
    pairs = trial.pairs
    return {'seed': trial.task.seed, 'kind': trial.task.kind, 'said': trial.said, 'found': stream_figures.found(pairs),
            'gap': stream_figures.gap(pairs), 'recoveries': stream_figures.recoveries(pairs),
            'jumps': stream_figures.jumps(pairs), 'pairs': [_plain_pair(p) for p in pairs]}


def _plain_pair(p: Pair) -> dict:
    a = p.answer
    return {'outcome': a.outcome.value, 'detail': a.detail, 'shown': a.device, 'right': a.right,
            'silent_failure': a.silent_failure,
            'confidence': _finite(a.confidence), 'errors_m': dataclasses.asdict(a.errors) if a.errors else None,
            'tip_off_m': None if p.tip_off is None else p.tip_off.tolist(), 'stray_m': _finite(p.stray),
            'seconds': p.seconds, 'cpu_s': _finite(a.cpu_s)}


def _finite(number: float) -> float | None:
    return None if math.isnan(number) else min(number, 1e12)
