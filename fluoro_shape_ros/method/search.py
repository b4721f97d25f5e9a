"""The search of whole images: hypotheses, best first, each brought to rest and judged, until one is beyond doubt or none is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.cameras import distort, isocenter, pixels_per_metre, project, undistort
from ..imaging.strips import Sheet
from .features import MEAN, MEAN_PX, TIP, TIP_PX
from .fit.fit import COARSE, Fit, fit
from .prediction import Guess, borne_out
from .propose.follow import follow
from .propose.lines import Hypothesis, Lines, by_lines, candidates
from .propose.other_lines import other_lines
from .propose.sweep import darkness, sweep

RESTLESS_PX = 0.3       # of a fit's last step: it has not come to rest yet, and is fitted once more
LIKELIEST = 2           # fits that are tried again with the line beside them taken away ...
SWEPT = 2               # ... and lines of either plane that are looked for in the other ...
SEEN = 0.6              # ... which must show this share of the line
HOPELESS = -10.0        # log odds below which a fit that has not come to rest is left there ...
PROMISING = -12.0       # ... and up to which nothing is worth a closer look ...
CLOSER = 8              # ... at so many more hypotheses
AS_PROPOSED = 2         # hypotheses that are fitted in the order in which they were proposed; the others in that of what is seen of them at first sight ...
FITTED = 8              # ... as long as there are fewer than so many


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


def tries(sheet: Sheet, radius: float, min_length_px: float, judge: Callable[[Fit], tuple[np.ndarray, float, bool]], settles: Callable[[float], bool],
          guess: Guess | None = None, leads: Sequence[Fit] = (), late: Callable[[], bool] = lambda: False,
          first_sight: Callable[[np.ndarray], float] | None = None) -> tuple[list[Attempt], tuple]:
    """All that was tried, and the line of each plane that stands out most, None where none does.

    judge: features and log odds of a fit, and whether its last end is the tip.
    settles: whether a fit with these log odds needs no other beside it. leads: fits that stand already.
    late: whether time is up, which once true stays so; asked before each step that takes long, and only where there is one left.
    first_sight: log odds of a curve (N, 3) that was not fitted; without it hypotheses are tried as they are proposed.
    """
    views, tried, seen = sheet.views, [], (None, None)

    def settled() -> bool:
        return bool(tried) and settles(max(t.log_odds for t in tried))

    def go(hypotheses: Iterator[Hypothesis]) -> None:
        """Fit each; once one is beyond doubt, only the same lines read the other way round, and these however late it is."""
        last = None
        for h in hypotheses:
            if settled() and not (last is not None and any(h.lines) and h.lines == last):
                break
            last = h.lines
            for _ in range(2):
                if not settled() and late():
                    return
                fitted = fit(sheet, h.curve, radius, h.coarse, clearing=h.clearing)
                if fitted is None or not (any(h.lines) or guess is None or borne_out(fitted.curve(100), guess)) or not _long_enough(fitted, min_length_px):
                    break
                tried.append(Attempt(fitted, h.lines, *judge(fitted)))
                if fitted.moved_px <= RESTLESS_PX or tried[-1].log_odds < HOPELESS:
                    break
                h = Hypothesis(fitted.curve(200), h.lines, clearing=h.clearing)     # it has not come to rest

    tried += [Attempt(f, (None, None), *judge(f)) for f in leads if _long_enough(f, min_length_px)]
    for faint in (False, True):
        if settled() or late():
            break
        found = candidates(sheet, radius, min_length_px, faint)
        if not faint:
            seen = tuple(lines[0].points_px if lines else None for lines in found)
        hypotheses = by_lines(views, found)
        go(hypotheses if first_sight is None else _most_promising(hypotheses, first_sight))
    if not settled() and (guess is not None or any(t.log_odds > PROMISING for t in tried)) and not late():
        go(islice(_again(sheet, radius, found, tried, guess, late), CLOSER))
    return tried, seen


def _most_promising(hypotheses: Iterator[Hypothesis], first_sight: Callable[[np.ndarray], float]) -> Iterator[Hypothesis]:
    """FITTED of them: the first as they come, the others by what is seen of them before any fit; those of the same two lines together."""
    yield from islice(hypotheses, AS_PROPOSED)
    others = list(hypotheses)
    odds = [first_sight(h.curve) for h in others]
    together = [max(o for o, other in zip(odds, others) if other.lines == h.lines) for h in others]
    yield from islice((others[k] for k in sorted(range(len(others)), key=lambda k: (-together[k], -odds[k]))), FITTED - AS_PROPOSED)


def _again(sheet: Sheet, radius: float, found, tried: list[Attempt], guess: Guess | None, late: Callable[[], bool]) -> Iterator[Hypothesis]:
    """Where else it may be, when no pair of lines settled it: where a guess leads; the likeliest fits without the lines beside them, and beside these; where
    the other plane shows what one plane's line alone says; and the likeliest again with a search around them."""
    path = None if guess is None else follow(sheet, guess, radius, clear=False)
    if path is not None:
        yield Hypothesis(path)
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
            if late():
                return
            path = sweep(undistort(view, c.points_px), (view, views[1 - k]), (dark[k], dark[1 - k]))
            if path is not None and path.share > SEEN:
                paths.append((np.sqrt(path.score) * path.share**2 * c.score, path.points, (c, None)[::1 - 2 * k]))
    yield from (Hypothesis(points, lines, clearing=True) for _, points, lines in sorted(paths, key=lambda p: -p[0]))
    yield from (Hypothesis(t.fit.curve(200), t.lines, coarse=COARSE, clearing=True) for t in likeliest)


def at_rest(sheet: Sheet, fitted: Fit | None, radius: float, **options) -> Fit | None:
    """A fit from a path that may be some px off, once more where it has not come to rest. options: of fit."""
    return fitted if fitted is None or fitted.moved_px <= RESTLESS_PX else fit(sheet, fitted.curve(200), radius, 0, **options)


def choose(tried: Sequence[Attempt]) -> tuple[Attempt, float]:
    """The likeliest attempt, and the probability that it is right: of curves that exclude one another at most one can be, by Bayes' rule p = o / (1 + sum of odds)."""
    ranked = sorted(tried, key=lambda t: -t.log_odds)
    best, rivals = ranked[0], []
    for t in ranked[1:]:
        if all(exclusive(t, r) for r in (best, *rivals)):
            rivals.append(t)
    odds = np.exp(np.clip([best.log_odds, *(r.log_odds for r in rivals)], -30, 30))
    return best, float(odds[0] / (1 + odds.sum()))


def exclusive(a: Attempt, b: Attempt) -> bool:
    """Whether at most one of two can be right: their tips, or one's course from the other's, lie apart by more than twice what may be wrong."""
    px = a.fit.s[1] - a.fit.s[0]
    if np.linalg.norm(a.tip - b.tip) > 2 * max(TIP, TIP_PX * px):
        return True
    one, other = a.fit.curve(100), b.fit.curve(100)
    return bool(min(cKDTree(one).query(other)[0].mean(), cKDTree(other).query(one)[0].mean()) > 2 * max(MEAN, MEAN_PX * px))


def projected(f: Fit, view) -> np.ndarray:
    """(200, 2) image pixels, as received, of the fitted curve."""
    return distort(view, project(view.P, f.curve(200)))


def _long_enough(f: Fit, min_length_px: float) -> bool:
    return (f.stop - f.start) / (f.s[1] - f.s[0]) >= min_length_px
