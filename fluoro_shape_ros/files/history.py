"""What is kept of a replay to be looked at afterwards: numbers of every pair, and all that was seen of as many pairs as
there is room for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..data import Outcome
from ..overlay import tip_sigma
from .offline import Answer

KEPT = 1024     # pairs that are kept whole; of more only every 2nd, 4th, ...
NONE = (float('nan'),) * 3


@dataclass(frozen=True)
class Row:
    """The numbers of a pair; NaN: there is none, or it is not known."""

    stamp_ns: int
    outcome: str
    detail: str
    warnings: tuple[str, ...]
    seconds: float                          # it took to compute
    length: float = float('nan')            # m
    tip: tuple[float, float, float] = NONE  # m
    sigma: float = float('nan')             # of the tip in its worst direction, m
    residual_px: tuple[float, float] = NONE[:2]     # median distance of the reprojected backbone to the centreline seen
                                                    # in plane A, B
    confidence: float = float('nan')        # of a rejected pair too

    @property
    def error_px(self) -> float:
        """The residual of the worse plane."""
        return max((r for r in self.residual_px if r == r), default=float('nan'))


class History:
    """Every pair's Row; `kept` has the answers of some, without their images, as (index of the row, answer)."""

    def __init__(self):
        self.rows: list[Row] = []
        self.kept: list[tuple[int, Answer]] = []
        self.worst: tuple[int, Answer] | None = None    # the pair with the largest residual
        self.refused: dict[str, tuple[int, Answer]] = {}    # by outcome, the first pair without a result
        self._step = 1

    def take(self, answer: Answer) -> None:
        """One more pair."""
        bare = dataclasses.replace(answer, frame=None, job=dataclasses.replace(answer.job, images=(None, None)))
        entry, row = (len(self.rows), bare), row_of(answer)
        self.rows.append(row)
        if row.error_px == row.error_px and (self.worst is None or row.error_px > self.rows[self.worst[0]].error_px):
            self.worst = entry
        if answer.result.shape is None:
            self.refused.setdefault(row.outcome, entry)
        if entry[0] % self._step == 0:
            self.kept.append(entry)
        if len(self.kept) > KEPT:
            self.kept, self._step = self.kept[::2], 2 * self._step

    def close(self) -> None:
        """Nothing is left to do."""

    @property
    def unanswered(self) -> tuple[int, Answer] | None:
        """The first pair without a result."""
        return next(iter(self.refused.values()), None)

    @property
    def median(self) -> tuple[int, Answer] | None:
        """The kept pair whose residual is nearest to the median of all."""
        errors = np.array([row.error_px for row in self.rows])
        known = [entry for entry in self.kept if errors[entry[0]] == errors[entry[0]]]
        if not known:
            return None
        middle = np.nanmedian(errors)
        return min(known, key=lambda entry: abs(errors[entry[0]] - middle))


def row_of(answer: Answer) -> Row:
    """The numbers of an answer."""
    result, shape = answer.result, answer.result.shape
    row = Row(answer.job.stamp_ns, result.outcome.value, '' if result.outcome is Outcome.OK else result.detail,
              result.warnings, answer.seconds, confidence=result.confidence)
    if shape is None:
        return row
    residuals = tuple(float(np.median(column[~np.isnan(column)])) if not np.isnan(column).all() else float('nan')
                      for column in shape.residuals_px.T)
    return dataclasses.replace(row, length=shape.length, tip=tuple(shape.tip.tolist()), sigma=tip_sigma(shape),
                               residual_px=residuals)
