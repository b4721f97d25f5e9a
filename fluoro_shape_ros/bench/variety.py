"""What the reconstruction does in a world as wide as the clinic: by family of scenes and kind of device, with what it
costs and why it refuses."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..cli import ToolError
from ..overlay import GOOD, REJECTED, TIP
from ..sim import ct
from . import sheets
from .case import Family
from .families import Sources, varied
from .open_scenes import TEXT
from .score import CHI2_95, RIGHT_MEAN_PX, RIGHT_TIP_PX, SILENT_MEAN, SILENT_TIP, WITHIN_MEAN, WITHIN_TIP, Answer, Trial
from .table import share

LIMITS = {'right_mean_m': WITHIN_MEAN, 'right_tip_m': WITHIN_TIP, 'right_mean_px': RIGHT_MEAN_PX,
          'right_tip_px': RIGHT_TIP_PX,
          'silent_mean_m': SILENT_MEAN, 'silent_tip_m': SILENT_TIP, 'honest_chi2': CHI2_95}
LEGEND = f"""\
right    of those with a device: mean <= {WITHIN_MEAN * 1e3:g} mm or {RIGHT_MEAN_PX:g} px there,
         and tip <= {WITHIN_TIP * 1e3:g} mm or {RIGHT_TIP_PX:g} px
silent   published, yet mean > {SILENT_MEAN * 1e3:g} mm or tip > {SILENT_TIP * 1e3:g} mm, or no device was there
honest   published, and the true tip lies in the reported 95 % ellipsoid: 95 % would be right; -: nothing reported
CPU      s a pair of all threads of a process whose libraries have one thread each: median and worst"""


# ---- which families there are


def known(sources: Sources) -> dict[str, Family]:
    """The families that exist with these sources. Raises ToolError that says at once what is wrong with one."""
    if sources.ct:
        try:
            ct.load_ct(sources.ct)
        except ct.CtError as error:
            raise ToolError(str(error)) from error
    return varied(sources)


def texts() -> dict[str, str]:
    """What each family is, by name, those that need a source too."""
    return {name: family.text for name, family in varied(Sources(ct=Path())).items()} | {'open': TEXT}


def needed(name: str) -> str:
    """The option without which a family does not exist; '' for one that always does, or never."""
    return '--open DIR' if name == 'open' else '--ct FILE' if name in texts() and name not in varied() else ''


def seeds(family: Family, first: int, scenes: int) -> range:
    """Of the scenes to try: so many from `first`, or of those that are counted, from 0."""
    return range(first, first + scenes) if family.count is None else range(min(scenes, family.count))


# ---- the table


@dataclass(frozen=True)
class Cost:
    """CPU time of a pair, s."""

    median: float
    worst: float


@dataclass(frozen=True)
class Row:
    """What a method does in a family, or with one kind of device of it; counts."""

    scenes: int
    shown: int                      # of these: both images show a device
    answered: int
    right: int
    silent: int
    reported: int                   # answers that came with a covariance
    honest: int                     # of these
    cpu_answered: Cost | None       # None: there were none
    cpu_refused: Cost | None
    rejections: dict[str, int]      # by reason, most frequent first


def rows(trials: Iterable[Trial]) -> dict[tuple[str, str, str], Row]:
    """A row a family, method and kind, in the order of the trials; the whole family comes first, with kind ''."""
    grouped: dict[tuple[str, str], dict[str, list[Answer]]] = {}
    for trial in trials:
        for method, answer in trial.answers.items():
            grouped.setdefault((trial.task.family, method), {}).setdefault(answer.kind, []).append(answer)
    found = {}
    for (family, method), by_kind in grouped.items():
        found[family, method, ''] = row([a for answers in by_kind.values() for a in answers])
        found |= {(family, method, kind): row(answers) for kind, answers in by_kind.items() if kind}
    return found


def row(answers: Sequence[Answer]) -> Row:
    """What the answers of one method come to."""
    reported = [a for a in answers if not math.isnan(a.surprise)]
    return Row(scenes=len(answers), shown=sum(a.device for a in answers), answered=sum(a.published for a in answers),
               right=sum(a.right for a in answers), silent=sum(a.silent_failure for a in answers),
               reported=len(reported), honest=sum(a.surprise <= CHI2_95 for a in reported),
               cpu_answered=_cost([a.cpu_s for a in answers if a.published]),
               cpu_refused=_cost([a.cpu_s for a in answers if not a.published]),
               rejections=dict(Counter(a.outcome.value for a in answers if not a.published).most_common()))


def table(trials: Sequence[Trial]) -> str:
    """A line a family, method and kind for a terminal, what the columns mean, and a total of each method."""
    found = rows(trials)
    width = max(12, *(len(family) + 2 for family, _, _ in found), *(len(kind) + 4 for _, _, kind in found))
    columns = (f'{"scenes":>6s} {"answered":>8s} {"right":>6s} {"silent":>6s} {"honest":>6s}'
               + 2 * f'  {"median":>6s} {"worst":>6s}')
    lines = [f'{"":{width + 7}s} {"":36s}  {"CPU answered":>13s}  {"CPU refused":>13s}',
             f'{"":{width + 7}s} {columns}  not answered']
    before = None
    for (family, method, kind), r in found.items():
        name = f'  {kind}' if kind else family if family != before else ''
        lines.append(f'{name:{width}s}{"" if kind else method:7s} {_cells(r)}'.rstrip())
        before = family
    return '\n'.join([*lines, '', LEGEND, '', *_totals(trials)])


def plain(trials: Sequence[Trial]) -> dict[str, dict]:
    """The rows for JSON, by 'family/method' and 'family/method/kind'; s."""
    return {'/'.join(filter(None, key)): dataclasses.asdict(r) for key, r in rows(trials).items()}


def plain_trial(trial: Trial) -> dict:
    """A trial for JSON, in m and s; what is not known is null."""
    first = next(iter(trial.answers.values()))
    return {'family': trial.task.family, 'seed': trial.task.seed, 'kind': first.kind, 'note': first.note,
            'device': first.device, 'px_m': _finite(first.px_m),
            'answers': {method: _plain_answer(a) for method, a in trial.answers.items()}}


def _plain_answer(a: Answer) -> dict:
    return {'outcome': a.outcome.value, 'detail': a.detail,
            'errors_m': dataclasses.asdict(a.errors) if a.errors else None, 'surprise': _finite(a.surprise),
            'right': a.right, 'silent_failure': a.silent_failure, 'confidence': _finite(a.confidence),
            'cpu_s': _finite(a.cpu_s)}


def _finite(number: float) -> float | None:
    return None if math.isnan(number) else min(number, 1e12)


def _cells(r: Row) -> str:
    reasons = ', '.join(f'{n} {reason}' for reason, n in r.rejections.items())
    costs = '  '.join(f'{c.median:6.2f} {c.worst:6.2f}' if c else f'{"-":>6s} {"-":>6s}'
                      for c in (r.cpu_answered, r.cpu_refused))
    return (f'{r.scenes:6d} {share(r.answered, r.scenes):>8s} {share(r.right, r.shown):>6s} {r.silent:6d} '
            f'{share(r.honest, r.reported):>6s}  {costs}  {reasons}')


def _totals(trials: Sequence[Trial]) -> list[str]:
    by_method: dict[str, list[Answer]] = {}
    for trial in trials:
        for method, answer in trial.answers.items():
            by_method.setdefault(method, []).append(answer)
    lines = []
    for method, answers in by_method.items():
        r, cost = row(answers), _cost([a.cpu_s for a in answers])
        lines.append(f'{method}: {r.right} of {r.shown} devices right ({share(r.right, r.shown)}), '
                     f'{r.silent} silent failures in {r.scenes} scenes ({100 * r.silent / r.scenes:.1f} %), '
                     f'CPU {cost.median:.2f} s a pair, {cost.worst:.2f} s at worst')
    return lines


def _cost(seconds: list[float]) -> Cost | None:
    return Cost(float(np.median(seconds)), max(seconds)) if seconds else None


# ---- pictures


def fewer_pictures(trials: Iterable[Trial], count: int) -> Iterator[Trial]:
    """The same trials, but only the first `count` of a family that have a thumbnail keep it."""
    kept = Counter()
    for trial in trials:
        kept[trial.task.family] += trial.thumbnail is not None
        yield trial if kept[trial.task.family] <= count else dataclasses.replace(trial, thumbnail=None)


def write_sheets(trials: Iterable[Trial], folder: Path) -> list[Path]:
    """Contact sheets of each family's trials that have a thumbnail. Raises OSError where `folder` can't be written."""
    cells: dict[str, list[sheets.Cell]] = {}
    for trial in trials:
        of_family = cells.setdefault(trial.task.family, [])
        if trial.thumbnail is not None:
            of_family.append(cell(trial))
    return [file for name, of_family in cells.items() for file in sheets.write(folder, name, of_family)]


def cell(trial: Trial) -> sheets.Cell:
    """A trial's pair, and what the first method said of it."""
    a = next(iter(trial.answers.values()))
    name = f'{trial.task.family} {trial.task.seed}' + (f' {a.kind}' if a.kind and a.kind != trial.task.family else '')
    errors = f': mean {a.errors.mean * 1e3:.2f}, tip {a.errors.tip * 1e3:.2f} mm' if a.errors else ''
    colour = TIP if a.silent_failure else GOOD if a.right or not a.device else REJECTED
    return sheets.Cell(trial.thumbnail, name, a.note, verdict(a) + errors, colour)


def verdict(a: Answer) -> str:
    """What an answer is worth, in words."""
    said = ('SILENT' if a.silent_failure else 'right' if a.right else 'published, not right' if a.published
            else f'refused: {a.outcome.value}')
    return said if a.device else f'no device, {said}'
