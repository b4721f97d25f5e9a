"""Results against ground truth, matched by stamp: what the demo counts and says."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..metrics import Errors, compare

PATIENCE_S = 2.0    # after which a pair has no answer


@dataclass(frozen=True)
class Answer:
    """A result whose truth is known."""

    stamp_ns: int
    latency_s: float    # stamp to arrival
    errors: Errors


class Score:
    """Truths and results as they come, in either order; times are those of the stamps' clock, ns."""

    def __init__(self):
        self.answers: list[Answer] = []
        self._truths: dict[int, np.ndarray] = {}
        self._results: dict[int, tuple[np.ndarray, float]] = {}     # those whose truth has not come yet
        self._answered: set[int] = set()

    def truth(self, stamp_ns: int, points: np.ndarray) -> None:
        """The true backbone (M, 3) of the pair of this stamp, m."""
        self._truths[stamp_ns] = points
        if stamp_ns in self._results:
            self._answer(stamp_ns, *self._results.pop(stamp_ns))

    def result(self, stamp_ns: int, points: np.ndarray, arrived_ns: int) -> None:
        """A backbone (N, 3) found for the pair of this stamp, m."""
        latency = (arrived_ns - stamp_ns) * 1e-9
        if stamp_ns in self._truths:
            self._answer(stamp_ns, points, latency)
        else:
            self._results[stamp_ns] = points, latency

    def _answer(self, stamp_ns: int, points: np.ndarray, latency_s: float) -> None:
        self._answered.add(stamp_ns)
        self.answers.append(Answer(stamp_ns, latency_s, compare(points, self._truths[stamp_ns])))

    @property
    def start_ns(self) -> int | None:
        """Stamp of the first pair; None before it."""
        return min(self._truths, default=None)

    def unanswered(self, now_ns: int) -> list[int]:
        """Stamps of the pairs that wait for more than PATIENCE_S, or were overtaken by an answered one."""
        newest = max(self._answered, default=0)
        return sorted(s for s in self._truths if s not in self._answered
                      and (s < newest or s < now_ns - PATIENCE_S * 1e9))


def live_line(score: Score, now_ns: int, reason: str = '') -> str:
    """The state of things and the last second's figures in one line; `reason` says why the last pair got no answer."""
    last = [a for a in score.answers if a.stamp_ns + a.latency_s * 1e9 > now_ns - 1e9]
    seconds = (now_ns - score.start_ns) * 1e-9
    missed = len(score.unanswered(now_ns))
    line = f'{seconds:5.1f} s  {len(last):4.1f} results/s'
    if last:
        line += (f'   latency {_median(a.latency_s for a in last) * 1e3:4.0f} ms   error: '
                 f'mean {_mm(a.errors.mean for a in last)} mm, tip {_mm(a.errors.tip for a in last)} mm')
    return (f'{line}   answered {len(score.answers)} of '
            f'{len(score.answers) + missed}{f"   [{reason}]" if reason else ""}')


def summary(score: Score, now_ns: int, not_answered: dict[str, int]) -> list[str]:
    """The lines to end with; `not_answered` counts pairs by the reason why they got no answer."""
    answers, missed = score.answers, len(score.unanswered(now_ns))
    lines = [f'answered    {len(answers)} of {len(answers) + missed} pairs']
    if answers:
        span = (answers[-1].stamp_ns - answers[0].stamp_ns) * 1e-9
        if span > 0:
            lines[0] += f', {(len(answers) - 1) / span:.1f} a second'
        lines.append(f'latency     median {_median(a.latency_s for a in answers) * 1e3:.0f} ms, '
                     f'worst {max(a.latency_s for a in answers) * 1e3:.0f} ms')
        for label, name in (('mean error', 'mean'), ('tip error', 'tip')):
            values = [getattr(a.errors, name) for a in answers]
            lines.append(f'{label:11s} median {_mm(values)} mm, 95th percentile {np.percentile(values, 95) * 1e3:.2f} '
                         f'mm, worst {max(values) * 1e3:.2f} mm')
    if not_answered:
        lines.append('no answer   ' + ', '.join(f'{name} {count}' for name, count in sorted(not_answered.items(),
                                                                                            key=lambda item: -item[1])))
    return lines


def headline(score: Score, now_ns: int) -> str:
    """The summary in one line, of a score with answers."""
    answers = score.answers
    return (f'{len(answers)} of {len(answers) + len(score.unanswered(now_ns))} pairs answered, '
            f'mean error {_mm(a.errors.mean for a in answers)} mm, tip error {_mm(a.errors.tip for a in answers)} '
            'mm (medians)')


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))


def _mm(values: Iterable[float]) -> str:
    return f'{_median(values) * 1e3:.2f}'
