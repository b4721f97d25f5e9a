"""The search of whole images: hypotheses, best first, each brought to rest and judged, until one is beyond doubt or
none is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from ..data import View
from ..geometry.cameras import distort, isocenter, pixels_per_metre, project, undistort
from ..geometry.curve import distance_to
from ..imaging.lines import Candidate
from ..imaging.strips import Sheet
from .features import MEAN, MEAN_PX, TIP, TIP_PX
from .fit.fit import COARSE, fit
from .fit.result import Fit
from .prediction import Guess, borne_out
from .propose.follow import follow
from .propose.lines import NEARLY, Hypothesis, Lines, by_lines, candidates
from .propose.other_lines import other_lines
from .propose.sweep import darkness, sweep

RESTLESS_PX = 0.3       # of a fit's last step: it has not come to rest yet, and is fitted once more
LIKELIEST = 2           # fits that are tried again with the line beside them taken away ...
SWEPT = 2               # ... and lines of either plane that are looked for in the other ...
SEEN = 0.6              # ... which must show this share of the line
HOPELESS = -10.0        # log odds below which a fit that has not come to rest is left there ...
PROMISING = -12.0       # ... and up to which nothing is worth a closer look ...
CLOSER = 8              # ... at so many more hypotheses
AS_PROPOSED = 2         # hypotheses, and all that are NEARLY as strong, that are fitted in the order in which they were
                        # proposed; the others in that of what is seen of them at first sight ...
BENDS = 3               # arcs on which it may go on past its ends, one after another
FITTED = 12             # ... as long as there are fewer than so many


@dataclass(frozen=True, eq=False)
class Attempt:
    """A hypothesis that was brought to rest, and how likely it is right."""

    fit: Fit
    lines: Lines
    features: np.ndarray    # of features.Features
    log_odds: float
    tip_is_last: bool

    @property
    def tip(self) -> np.ndarray:
        """(3,) m."""
        return self.fit.curve(2)[int(self.tip_is_last)]


class Search:
    """A search of a pair of whole images. It may be interrupted between its steps, and go on later with the same pair.

    judge: features and log odds of a fit, and whether its last end is the tip.
    settles: whether a fit with these log odds needs no other beside it. leads: fits that stand already.
    first_sight: log odds of a curve (N, 3) that was not fitted; without it hypotheses are tried as they are proposed.
    measured: what is made of a fit before it is judged.
    """

    def __init__(self, sheet: Sheet, radius: float, min_length_px: float,
                 judge: Callable[[Fit], tuple[np.ndarray, float, bool]],
                 settles: Callable[[float], bool], guess: Guess | None = None, leads: Sequence[Fit] = (),
                 first_sight: Callable[[np.ndarray], float] | None = None,
                 measured: Callable[[Fit], Fit] = lambda f: f):
        self.tried: list[Attempt] = []
        self.lines: tuple = (None, None)        # (N, 2) image pixels of the line of each plane that stands out most
        self.finished = False
        self._sheet, self._radius, self._min_length_px, self._guess = sheet, radius, min_length_px, guess
        self._judge, self._settles, self._first_sight, self._measured = judge, settles, first_sight, measured
        self._steps = self._all_steps(leads)

    def go_on(self, late: Callable[[], bool] = lambda: False) -> None:
        """To the end, or until time is up, which is asked before each step that takes long, and only where there is one
        left."""
        while not self.finished:
            self.finished = next(self._steps, True)
            if not self.finished and late():
                return

    def likeliest(self, radius: float, sheet: Sheet) -> list[Fit]:
        """What it found, in another pair, which was taken a little later."""
        best: list[Attempt] = []
        for t in sorted(self.tried, key=lambda t: -t.log_odds):
            if t.log_odds > PROMISING and all(exclusive(t, b) for b in best) and len(best) < 1 + LIKELIEST:
                best.append(t)
        fits = [at_rest(sheet, fit(sheet, t.fit.curve(200), radius, COARSE), radius) for t in best]
        return [f for f in fits if f is not None and _long_enough(f, self._min_length_px)]

    def _settled(self) -> bool:
        return bool(self.tried) and self._settles(max(t.log_odds for t in self.tried))

    def _all_steps(self, leads: Sequence[Fit]) -> Iterator[bool]:
        """False before each step that takes long."""
        sheet, radius = self._sheet, self._radius
        self.tried += [Attempt(f, (None, None), *self._judge(f)) for f in leads if _long_enough(f, self._min_length_px)]
        lines: tuple[list[Candidate], list[Candidate]] = ([], [])
        for faint in (False, True):
            if self._settled():
                break
            yield False
            found = candidates(sheet, radius, self._min_length_px, faint)
            if not faint:
                self.lines = tuple(c[0].points_px if c else None for c in found)
            lines = lines[0] + found[0], lines[1] + found[1]    # one plane may show clearly what the other hardly does
            before = [t.lines for t in self.tried]
            hypotheses = (h for h in by_lines(sheet.views, lines) if h.lines not in before)
            yield from self._try(hypotheses if self._first_sight is None
                                 else _most_promising(hypotheses, self._first_sight))
        if not self._settled() and (self._guess is not None or any(t.log_odds > PROMISING for t in self.tried)):
            yield False
            yield from self._try(_at_most(CLOSER, _again(sheet, radius, found, self.tried, self._guess)))

    def _try(self, hypotheses: Iterator[Hypothesis | None]) -> Iterator[bool]:
        """Fit each; once one is beyond doubt, only what was proposed NEARLY as strongly, and the same lines read the
        other way round, these however late it is."""
        last, strongest = None, 0.0
        for h in hypotheses:
            if h is None:
                if self._settled():
                    break
                yield False
                continue
            strongest = max(strongest, h.score)
            if self._settled() and not (last is not None and any(h.lines) and h.lines == last):
                if h.score <= NEARLY * strongest:
                    break
                yield False
            last = h.lines
            yield from self._bring_to_rest(h)

    def _bring_to_rest(self, h: Hypothesis, bends: int = BENDS) -> Iterator[bool]:
        """Fit it, once more where that has not come to rest, and where it seems to go on in a bend, that, too."""
        for _ in range(2):
            if not self._settled():
                yield False
            fitted = fit(self._sheet, h.curve, self._radius, h.coarse, clearing=h.clearing)
            if fitted is None or not _long_enough(fitted, self._min_length_px):
                return
            # where no line but a guess led to it, it has to bear that out
            borne = any(h.lines) or self._guess is None or borne_out(fitted.curve(100), self._guess)
            if borne:
                final = self._measured(fitted)
                self.tried.append(Attempt(final, h.lines, *self._judge(final)))
            if fitted.moved_px <= RESTLESS_PX or borne and self.tried[-1].log_odds < HOPELESS:
                break
            h = Hypothesis(fitted.curve(200), h.lines, clearing=h.clearing)     # it has not come to rest
        if bends and borne and fitted and fitted.bent is not None and self.tried[-1].log_odds > HOPELESS:
            yield from self._bring_to_rest(Hypothesis(fitted.bent, h.lines, 1, h.clearing), bends - 1)


def _at_most(count: int, hypotheses: Iterator[Hypothesis | None]) -> Iterator[Hypothesis | None]:
    """So many of them, not counting None."""
    for h in hypotheses:
        yield h
        count -= h is not None
        if count == 0:
            return


def _most_promising(hypotheses: Iterator[Hypothesis],
                    first_sight: Callable[[np.ndarray], float]) -> Iterator[Hypothesis | None]:
    """FITTED of them: the strongest as they come, the others by what is seen of them before any fit; those of the same
    two lines together. None before each look."""
    others, odds, strongest, tried = list[Hypothesis](), list[float](), 0.0, 0
    for h in hypotheses:
        strongest = max(strongest, h.score)
        if tried < AS_PROPOSED or tried < FITTED and h.score > NEARLY * strongest:
            tried += 1
            yield h
            continue
        yield None
        others.append(h)
        odds.append(first_sight(h.curve))
    together = [max(o for o, other in zip(odds, others) if other.lines == h.lines) for h in others]
    yield from islice((others[k] for k in sorted(range(len(others)), key=lambda k: (-together[k], -odds[k]))),
                      FITTED - tried)


def _again(sheet: Sheet, radius: float, found: tuple[list[Candidate], list[Candidate]], tried: list[Attempt],
           guess: Guess | None) -> Iterator[Hypothesis | None]:
    """Where else it may be, when no pair of lines settled it: where a guess leads; the likeliest fits without the lines
    beside them, and beside these; where the other plane shows what one plane's line alone says; and the likeliest again
    with a search around them. None before what takes long."""
    led = None if guess is None else follow(sheet, guess, radius, clear=False)
    if led is not None:
        yield Hypothesis(led)
    likeliest = [t for t in sorted(tried, key=lambda t: -t.log_odds) if t.log_odds > PROMISING][:LIKELIEST]
    for t in likeliest:
        yield Hypothesis(t.fit.curve(200), t.lines, clearing=True)
        yield from (Hypothesis(points, t.lines, clearing=True) for points in other_lines(sheet, t.fit, radius))
    views, center = sheet.views, isocenter(sheet.views)[None]
    widths = [radius * pixels_per_metre(v.P, center) for v in views]
    dark = [darkness(*plane) for plane in zip(sheet.planes, sheet.fields, widths)]
    paths = []
    for k, (view, lines) in enumerate(zip(views, found)):
        for c in lines[:SWEPT]:
            yield None
            path = sweep(undistort(view, c.points_px), (view, views[1 - k]), (dark[k], dark[1 - k]))
            if path is not None and path.share > SEEN:
                paths.append((np.sqrt(path.score) * path.share**2 * c.score, path.points,
                              (None, c) if k else (c, None)))
    yield from (Hypothesis(points, lines, clearing=True) for _, points, lines in sorted(paths, key=lambda p: -p[0]))
    yield from (Hypothesis(t.fit.curve(200), t.lines, coarse=COARSE, clearing=True) for t in likeliest)


def at_rest(sheet: Sheet, fitted: Fit | None, radius: float, **options: Any) -> Fit | None:
    """A fit from a path that may be some px off, once more where it has not come to rest. options: of fit."""
    return (fitted if fitted is None or fitted.moved_px <= RESTLESS_PX
            else fit(sheet, fitted.curve(200), radius, 0, **options))


def choose(tried: Sequence[Attempt]) -> tuple[Attempt, float]:
    """The likeliest attempt, and the sum of the odds of the likeliest others that exclude it and one another."""
    best, *others = sorted(tried, key=lambda t: -t.log_odds)
    rivals = list[Attempt]()
    for t in others:
        if all(exclusive(t, r) for r in (best, *rivals)):
            rivals.append(t)
    return best, float(np.exp(np.clip([r.log_odds for r in rivals], -30, 30)).sum())


def exclusive(a: Attempt, b: Attempt) -> bool:
    """Whether at most one of two can be right: their tips, or one's course from the other's, lie apart by more than
    twice what may be wrong."""
    px = a.fit.s[1] - a.fit.s[0]
    if np.linalg.norm(a.tip - b.tip) > 2 * max(TIP, TIP_PX * px):
        return True
    one, other = a.fit.curve(100), b.fit.curve(100)
    return bool(min(distance_to(one, other).mean(), distance_to(other, one).mean())
                > 2 * max(MEAN, MEAN_PX * px))


def projected(f: Fit, view: View) -> np.ndarray:
    """(200, 2) image pixels, as received, of the fitted curve."""
    return distort(view, project(view.P, f.curve(200)))


def _long_enough(f: Fit, min_length_px: float) -> bool:
    return (f.stop - f.start) / (f.s[1] - f.s[0]) >= min_length_px
