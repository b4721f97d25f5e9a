"""What trials come to: shares and errors of a family and method, as numbers and as a table for a terminal."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from .score import CHI2_95, SILENT_MEAN, SILENT_TIP, WITHIN_MEAN, WITHIN_TIP, Answer, Trial

# of metrics.Errors: heading
ERRORS = {'mean': 'closest point', 'missed': 'and back', 'tip': 'tip', 'length': 'length', 'matched': 'matched'}
BOUND = 'bound'
LEGEND = f"""\
within   mean <= {WITHIN_MEAN * 1e3:g} mm and tip <= {WITHIN_TIP * 1e3:g} mm
silent   published, yet mean > {SILENT_MEAN * 1e3:g} mm or tip > {SILENT_TIP * 1e3:g} mm, or no device was there
honest   published, and the true tip lies in the reported 95 % ellipsoid: 95 % would be right; -: nothing reported
errors   of what was published, mm: mean, 95th percentile, worst. Closest point: found curve to true one;
         and back: true one to found; matched: at equal arc length from the tip
bound    Cramer-Rao: expected closest-point distance, rms of tip and length"""


@dataclass(frozen=True)
class Stat:
    """Of one error over scenes, m."""

    mean: float
    p95: float
    worst: float


@dataclass(frozen=True)
class Row:
    """What a method does in a family; counts, and errors by name."""

    scenes: int
    device: bool                    # whether the family's images show one
    answered: int
    within: int
    silent: int
    reported: int                   # answers that came with a covariance
    honest: int                     # of these
    rejections: dict[str, int]      # by reason, most frequent first
    errors: dict[str, Stat]


def rows(trials: Iterable[Trial]) -> dict[tuple[str, str], Row]:
    """A row a family and method, in the order of the trials; the bound of a family comes under the method BOUND."""
    answers, bounds = {}, {}
    for trial in trials:
        for method, answer in trial.answers.items():
            answers.setdefault(trial.task.family, {}).setdefault(method, []).append(answer)
        if trial.bound:
            bounds.setdefault(trial.task.family, []).append(trial.bound)
    found = {}
    for family, by_method in answers.items():
        found |= {(family, method): row(given) for method, given in by_method.items()}
        if family in bounds:
            found[family, BOUND] = Row(len(bounds[family]), True, 0, 0, 0, 0, 0, {}, _stats(bounds[family]))
    return found


def row(answers: list[Answer]) -> Row:
    """What the answers of one method come to."""
    reasons = Counter(a.outcome.value for a in answers if not a.published)
    known = [a for a in answers if not np.isnan(a.surprise)]
    return Row(scenes=len(answers), device=any(a.device for a in answers), answered=sum(a.published for a in answers),
               within=sum(a.within for a in answers), silent=sum(a.silent_failure for a in answers),
               reported=len(known),
               honest=sum(a.surprise <= CHI2_95 for a in known), rejections=dict(reasons.most_common()),
               errors=_stats([a.errors for a in answers if a.errors]))


def table(found: dict[tuple[str, str], Row]) -> str:
    """Two blocks of lines, a line a family and method: shares with reasons, then errors in mm; and what the columns
    mean."""
    return '\n'.join([*_shares(found), '', *_errors(found), '', LEGEND, '', *_totals(found)])


def plain(found: dict[tuple[str, str], Row]) -> dict[str, dict]:
    """The rows for JSON, by 'family/method'; errors in m."""
    return {f'{family}/{method}': dataclasses.asdict(r) for (family, method), r in found.items()}


def share(part: int, whole: int) -> str:
    """Per cent; '-' of nothing."""
    return f'{100 * part / whole:.0f} %' if whole else '-'


def _shares(found) -> list[str]:
    lines = [f'{"":19s} {"scenes":>6s} {"answered":>8s} {"within":>7s} {"silent":>6s} {"honest":>7s}  not answered']
    for family, method, r in _named(found):
        if method.strip() != BOUND:
            reasons = ', '.join(f'{n} {reason}' for reason, n in r.rejections.items())
            within = share(r.within, r.scenes) if r.device else '-'
            lines.append(f'{family} {method} {r.scenes:6d} {share(r.answered, r.scenes):>8s} {within:>7s} '
                         f'{r.silent:6d} {share(r.honest, r.reported):>7s}  {reasons}'.rstrip())
    return lines


def _errors(found) -> list[str]:
    lines = [f'{"error (mm)":19s}' + ''.join(f'{heading:^19s}' for heading in ERRORS.values()).rstrip()]
    for family, method, r in _named(found):
        if r.errors:
            lines.append(f'{family} {method}' + ''.join(_cell(r.errors.get(name)) for name in ERRORS).rstrip())
    return lines


def _totals(found) -> list[str]:
    lines = []
    for method in dict.fromkeys(m for _, m in found if m != BOUND):
        mine = [r for (_, m), r in found.items() if m == method]
        scenes, silent = sum(r.scenes for r in mine), sum(r.silent for r in mine)
        lines.append(f'{method}: {silent} silent failures in {scenes} scenes ({100 * silent / scenes:.1f} %)')
    return lines


def _named(found):
    """Family, method and row; a family's name stands at its first line only."""
    before = None
    for (family, method), r in found.items():
        yield f'{"" if family == before else family:11s}', f'{method:7s}', r
        before = family


def _stats(values: list) -> dict[str, Stat]:
    """The Stat of each error that the (dataclass) values have; none without values."""
    names = [n for n in ERRORS if values and hasattr(values[0], n)]
    columns = {n: np.array([getattr(v, n) for v in values]) for n in names}
    return {n: Stat(float(c.mean()), float(np.percentile(c, 95)), float(c.max())) for n, c in columns.items()}


def _cell(stat: Stat | None) -> str:
    numbers = [_mm(x) for x in (stat.mean, stat.p95, stat.worst)] if stat else ['', '-', '']
    return '  ' + ' '.join(f'{x:>5s}' for x in numbers)


def _mm(metres: float) -> str:
    """In mm, in five characters or less."""
    mm = metres * 1e3
    return f'{mm:.3f}' if mm < 9.9995 else f'{mm:.1f}' if mm < 999.95 else f'{mm:.0f}'
