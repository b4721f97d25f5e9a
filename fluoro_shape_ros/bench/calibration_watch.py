"""From which error on the calibration watch notices that plane B's calibration is wrong, and how often it cries with a
right one."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ..cli import ToolError, count, natural
from ..config import Config
from ..data import Prior, View
from ..device import load_device
from ..geometry.cameras import make_view
from ..jobs import in_order
from ..method.pipeline import reconstruct
from ..ros.calibration_watch import CalibrationWatch, Finding
from ..sim import carm, scenes

SIZE, PIXEL = 512, 0.3e-3       # px, m at the isocentre
LENGTHS = 0.067, 0.110          # m, that fit into such a field
RATE = 8.0                      # pairs a second
KINDS = ('a rod', 'a rod that enters through the border', 'a rod tangent to its epipolar lines', 'tube',
         'cannula', 'tendon')     # in turn, by the seed
SHIFTS, TURNS, SCALES = (0.2, 0.5, 1.0, 2.0, 5.0), (0.2, 0.5, 1.0, 2.0), (0.2, 0.5, 1.0, 2.0)      # px, degrees, %
NONE, EXCHANGED = 'none', 'exchanged'


def misplaced(view: View, shift_px: tuple[float, float] = (0.0, 0.0), turn: float = 0.0, scale: float = 1.0) -> View:
    """The view of an image that was moved, turned about its centre (rad, from u to v) and scaled."""
    middle = np.array([(view.width - 1) / 2, (view.height - 1) / 2])
    M = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    A = np.block([[M, (middle - M @ middle + shift_px)[:, None]], [np.zeros(2), 1.0]])
    return make_view(view.name, A @ view.P, view.width, view.height)


ERRORS: dict[str, Callable[[View], View]] = {
    NONE: lambda view: view,
    **{f'shifted along u by {px:g} px': partial(misplaced, shift_px=(px, 0.0)) for px in SHIFTS},
    **{f'shifted along v by {px:g} px': partial(misplaced, shift_px=(0.0, px)) for px in SHIFTS},
    **{f'turned by {degrees:g} degrees': partial(misplaced, turn=np.deg2rad(degrees)) for degrees in TURNS},
    **{f'scaled by {percent:g} %': partial(misplaced, scale=1 + percent / 100) for percent in SCALES},
    EXCHANGED: lambda view: view,
}


def views_with(error: str, views: tuple[View, View]) -> tuple[View, View]:
    """The views that a user gives whose plane B has this of ERRORS; or whose planes are exchanged."""
    a, b = views
    return ((dataclasses.replace(b, name='a'), dataclasses.replace(a, name='b'))
            if error == EXCHANGED else (a, ERRORS[error](b)))


def add(commands) -> None:
    """The command's arguments."""
    text = 'from which error on it is noticed that plane B\'s calibration is wrong, and how often with a right one'
    command = commands.add_parser('calibration_watch', help=text, description=f'{text[0].upper()}{text[1:]}.',
                                  epilog='errors:\n' + '\n'.join(f'  {name}' for name in ERRORS),
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument('--runs', type=count, default=len(KINDS), metavar='N',
                         help=f'(default: {len(KINDS)}: {", ".join(KINDS)}, in turn by the seed)')
    command.add_argument('--pairs', type=count, default=24, metavar='N', help='of each (default: 24)')
    command.add_argument('--errors', nargs='+', choices=list(ERRORS), default=list(ERRORS), metavar='ERROR',
                         help='(default: all)')
    command.add_argument('--first-seed', type=natural, default=0, metavar='SEED',
                         help='seeds count up from here (default: 0)')
    command.add_argument('--jobs', type=count, default=2, metavar='N',
                         help='processes of one thread each; the table does not depend on it (default: 2)')
    command.add_argument('--json', type=Path, metavar='FILE', help='write what was found in every run there')
    command.set_defaults(body=_body)


def _body(args, parser: argparse.ArgumentParser) -> int:
    """Try all runs, print the table, write the file."""
    if args.json and not args.json.absolute().parent.is_dir():
        raise ToolError(f'{args.json}: there is no such folder')
    tasks = [Task(args.first_seed + k, tuple(dict.fromkeys(args.errors)), args.pairs) for k in range(args.runs)]
    runs = list(tqdm(in_order(attempt, tasks, args.jobs), total=len(tasks), unit='run', disable=None))
    print(report(runs, args.pairs))
    if args.json:
        found = [{'seed': task.seed, 'kind': KINDS[task.seed % len(KINDS)], **dataclasses.asdict(w),
                  'words': str(w.finding)} for task, run in zip(tasks, runs) for w in run]
        args.json.write_text(json.dumps({'command': args.command, 'pairs': args.pairs, 'runs': found}, indent=1) + '\n')
    return 0


@dataclass(frozen=True)
class Task:
    """A run to try."""

    seed: int
    errors: tuple[str, ...]
    pairs: int


@dataclass(frozen=True)
class Watched:
    """What was found in one run with one error."""

    error: str
    answered: int           # pairs
    after: int | None       # pairs after which it was noticed first; None: it was not
    finding: Finding


def moving_run(seed: int) -> scenes.Run:
    """One of KINDS in front of drawn anatomy."""
    kind, make = KINDS[seed % len(KINDS)], partial(scenes.xray_run, seed,
                                                   views=carm.biplane(arm=carm.CArm(pixel_size_iso=PIXEL, width=SIZE,
                                                                                    height=SIZE)), lengths=LENGTHS)
    if ' ' in kind:
        return make(entering='enters' in kind, kind='tangent' if 'tangent' in kind else 'spline')
    device = load_device(kind)
    return make(device=device, radius=device.radius, chains=(scenes.FLUOROSCOPY, scenes.FLUOROSCOPY))


def attempt(task: Task) -> list[Watched]:
    """One run with each of its errors; the images are the same."""
    seen = list(scenes.moving(moving_run(task.seed), RATE, task.pairs))
    return [watched(seen, error) for error in task.errors]


def watched(seen: list[scenes.Scene], error: str) -> Watched:
    """What the watch says of a run that is tracked from pair to pair. Once there is a result no pair has time for a
    search of the whole images, which would tell the watch no more; time that is up from the start is the same on any
    machine."""
    watch, prior, answered, after = CalibrationWatch(), Prior(), 0, None
    config = Config.from_values(robot_radius=float(seen[0].radius), base_position=seen[0].base_position.tolist())
    views = views_with(error, seen[0].frame.views)
    for k, scene in enumerate(seen):
        stamp_ns = round(k / RATE * 1e9)
        result = reconstruct(dataclasses.replace(scene.frame, stamp_ns=stamp_ns, views=views), config, prior,
                             None if prior.previous is None else -np.inf)
        if result.shape is not None:
            prior = Prior(result.shape, stamp_ns, prior.previous, prior.previous_stamp_ns)
            answered += 1
        watch.take(result, views, error)
        after = k + 1 if after is None and watch.finding.noticed else after
    return Watched(error, answered, after, watch.finding)


def report(runs: list[list[Watched]], pairs: int) -> str:
    """The table: a row an error."""
    width = max(map(len, ERRORS))
    lines = [f'{"plane B":{width}s} {"noticed":>9s} {"after":>6s} {"answered":>9s} {"says px":>8s}  as what']
    lines += [_line([w for run in runs for w in run if w.error == error], width, pairs)
              for error in dict.fromkeys(w.error for run in runs for w in run)]
    return '\n'.join([*lines, '', LEGEND])


LEGEND = f"""\
runs       of {', '.join(KINDS)}, in turn by the seed; {SIZE} x {SIZE} px of {PIXEL * 1e3:g} mm, drawn anatomy,
           {RATE:g} pairs/s; u runs nearly along the epipolar lines
after      pairs until it was noticed, median; answered: share of all pairs, without a search once there is a result
says       px across the epipolar lines, median of the runs where it was noticed"""


def _line(found: list[Watched], width: int, pairs: int) -> str:
    noticed = [w for w in found if w.finding.noticed]
    after, says = (f'{np.median(values):{form}}' if noticed else '' for values, form in
                   (([w.after for w in noticed], '.0f'), ([w.finding.apart_px for w in noticed], '.1f')))
    like = Counter(kind for w in noticed for kind in ('shifted', 'turned', 'too large', 'exchanged')
                   if kind in w.finding.looks_like)
    return (f'{found[0].error:{width}s} {f"{len(noticed)} of {len(found)}":>9s} {after:>6s} '
            f'{100 * sum(w.answered for w in found) / (pairs * len(found)):7.0f} % '
            f'{says:>8s}  {", ".join(f"{n} {kind}" for kind, n in like.most_common())}').rstrip()

