"""method:=spline from images to a fitted curve: ridges > candidates > the pair that is one device > a spline on both images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from ..imaging.ridges import find_ridges, ridge_scale, shrinking
from ..imaging.lines import Candidate, find_candidates
from ..data import Outcome
from .fit.fit import COARSE, Fit, fit
from .propose.follow import follow
from ..geometry.cameras import distort, fundamental, isocenter, pixels_per_metre, project, undistort
from .propose.other_lines import other_lines
from .propose.alignment import align
from .plausibility import CLEARER, MIN_WEAKEST, alike_device, blunt, clear, doubt, evidence
from .prediction import Guess, borne_out, whole
from .propose.first_curve import first_curve
from ..imaging.profiles import apparent_width, likeness, odd_width, pieces
from ..imaging.strips import Sheet, cut_along, half_width_range
from .propose.sweep import darkness, sweep

LINES = 14              # strongest lines of an image that are looked at closely
CANDIDATES = 6          # most device-like ones among them that are compared between the planes ...
HOPELESS = 0.03         # ... unless they are that much less like it than the best
HYPOTHESES = 4          # alignments that are fitted before one is chosen
AGAIN = 2               # where the best is in doubt: how many of them are fitted again ...
SWEPT = 2               # ... and how many lines of either plane are looked for in the other ...
SEEN = 0.6              # ... which must show this share of the line
FLIPPED = 0.7           # alignment of a pair of lines read the other way round, as a share of the better way's, that must be looked at, too ...
RIVAL, APART = 0.7, 5e-3        # ... and the weight of a curve that far from the chosen one, m, as a share of its weight, that makes it a rival ...
SHARPER = 3.5           # ... unless the ends of one are clearer by this, as the planes agree on them
BESIDE = 2e-3           # m: as far from a curve for which more speaks, but for clear ends, one found by taking lines away is not believed
UNASKED = 0.8           # the share of a fit that no line of the images led to: it must have more for it than one that some did
EXPLAINED_PX = 3.0
MIN_EXPLAINED = 0.4     # less of a line than this, and it is another line
CONVINCING = 0.6        # evidence for a length of 1 m that needs no other hypothesis beside it ...
PROMISING = 0.08        # ... and that makes another try worth while
LOOKED_PX = 48.0        # past both ends of the path that a guess leads to, which often stops short of the device's
SHARP = 0.5e-3          # m: an end less certain than this may be another one
STRAYED_PX = 8.0        # of a path from the fit that began there: unless its ends are clear, it has lost part of the device
RESTLESS_PX = 0.3       # of a fit's last step: it has not come to rest yet, and is fitted once more
ASIDE = 0.6             # darkness beside where a tracked fit would go on, as a share of the device's, that makes one search anew
JUMPED = 4e-3           # m: an end farther from where it was, or should be by now, may have slipped on to another line


@dataclass(frozen=True)
class Detection:
    """What the images show: a fit, or the reason why there is none; and the device's candidates as seen, for the overlay."""

    fit: Fit | None
    outcome: Outcome
    detail: str
    seen_px: tuple[np.ndarray | None, np.ndarray | None]    # (N, 2) image pixels as received
    doubt: tuple[Outcome, str] | None = None    # why the fit may not be believed
    sure: bool = True       # whether nothing else in the images need be looked at


Lines = tuple[Candidate | None, Candidate | None]       # of planes a and b; None where the line there is not the device's
Start = tuple[np.ndarray, Lines, int]   # (M, 3) m of a first curve, the lines that say so, and how often the fit searches around it


@dataclass(frozen=True)
class Attempt:
    """A fit that is tried, and what speaks for it."""

    fit: Fit
    share: float            # of the lines it comes from that it explains
    weight: float           # that share of its evidence
    doubt: tuple[Outcome, str] | None
    lines: Lines
    start: np.ndarray       # (M, 3) m
    expected: bool          # whether a prediction has it there

    @property
    def convincing(self) -> bool:
        return self.share * _speaks(self.fit, self.expected) > CONVINCING

    @property
    def plain(self) -> float:
        """The weight without what clear ends add: of two curves by the same lines one may have them by chance."""
        return self.weight / (CLEARER if clear(self.fit) else 1.0)

    @property
    def believed(self) -> bool:
        """Whether it needs no other attempt beside it."""
        return self.convincing and not self.doubt and (self.fit.alone < 0).all()

    @property
    def promising(self) -> bool:
        return self.weight > PROMISING * np.sqrt(self.fit.stop - self.fit.start)


def detect(sheet: Sheet, radius: float, min_length_px: float, guess: Guess | None = None, leads: Sequence[Fit] = ()) -> Detection:
    """Search both whole images (dark device, even noise) for the device of `radius` m; a guess that a curve bears out speaks for that.

    leads: fits to compare with what is found.
    """
    views = sheet.views
    center = isocenter(views)[None]
    widths = [radius * pixels_per_metre(v.P, center) for v in views]
    candidates = [candidates_of(*plane, min_length_px) for plane in zip(sheet.planes, sheet.fields, widths)]
    best = tuple(c[0].points_px if c else None for c in candidates)
    missing = next(((outcome, f'no line of at least {min_length_px:g} px stands out')
                    for found, outcome in zip(candidates, (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)) if not found), None)
    if missing and guess is None:
        return Detection(None, *missing, best)

    def attempt_of(fitted: Fit, lines: Lines, start: np.ndarray) -> Attempt:
        share = min((explained(fitted, v, undistort(v, c.points_px), c.z > 0) for v, c in zip(views, lines) if c is not None), default=UNASKED)
        expected = _expected(fitted, guess)
        return Attempt(fitted, share, share * evidence(fitted, expected), doubt(fitted, min_length_px, expected), lines, start, expected)

    def attempts(starts, times: int, clearing: bool = False) -> Iterator[Attempt]:
        """Fits, each as often again from where it came to lie: a start some px off may catch on another line where the next does not."""
        for points, lines, coarse in starts:
            for _ in range(times):
                fitted = fit(sheet, points, radius, coarse, clearing=clearing)
                if not any(lines):
                    fitted = _at_rest(sheet, fitted, radius, clearing=clearing)
                if fitted is None:
                    break
                attempt = attempt_of(fitted, lines, points)
                if not (any(lines) or attempt.expected):
                    break       # the guess led to another line
                yield attempt
                if not attempt.promising:
                    break
                points = fitted.curve(200)

    tried, settled = [attempt_of(f, (None, None), f.curve(200)) for f in leads], None
    for attempt in attempts((start for start in _pairs(views, candidates) if settled is None or start[1] == settled.lines), 1):
        tried.append(attempt)
        if settled is None and attempt.believed:
            settled = attempt       # but for the same lines read the other way round
    chosen = max(tried, key=lambda t: t.weight, default=None)
    if chosen is None or not chosen.believed:
        path = None if guess is None else follow(sheet, guess, radius, clear=False)
        if chosen is not None or path is not None:
            chosen = _second_look(partial(attempts, times=2, clearing=True), sheet, radius, candidates, widths, tried, path) or chosen
    if chosen is None:
        none = Outcome.NO_CORRESPONDENCE, f'no line of plane a ({len(candidates[0])}) is one of plane b ({len(candidates[1])})'
        return Detection(None, *(missing or none), best)
    others = [t for t in tried if any(chosen.lines) and t.lines == chosen.lines and t.plain > RIVAL * chosen.plain and _apart(t.fit, chosen.fit) > APART]
    if others:      # lines along epipolar lines: only the ends tell which way round they belong together
        chosen, second, *_ = sorted([chosen, *others], key=lambda t: t.fit.end_sigma.max())
        if second.fit.end_sigma.max() < SHARPER * chosen.fit.end_sigma.max():
            return Detection(None, Outcome.NO_CORRESPONDENCE, 'two curves in space explain the same lines alike: they run along epipolar lines', best)
    seen = tuple(_projected(chosen.fit, v) if c is None else c.points_px for v, c in zip(views, chosen.lines))
    if chosen.share < MIN_EXPLAINED:
        return Detection(None, Outcome.POORLY_EXPLAINED, f'only {100 * chosen.share:.0f} % of the line seen in one plane are explained', seen)
    return Detection(chosen.fit, Outcome.OK, 'ok', seen, chosen.doubt)


def _pairs(views, candidates) -> Iterator[Start]:
    """Where the device may be by a line of each plane, most likely first; the same lines in the other direction only where that fits about as well."""
    if not all(candidates):
        return
    curves = [[undistort(v, c.points_px) for c in found] for v, found in zip(views, candidates)]
    F = fundamental(views[0].P, views[1].P)
    scores = {}
    for alignment in align(*curves, [np.array([c.score for c in found]) for found in candidates], F, best=HYPOTHESES):
        a, b = alignment.a, alignment.b
        if alignment.score < FLIPPED * scores.setdefault((a, b), alignment.score):
            continue
        yield first_curve(views, curves[0][a], curves[1][b], alignment), (candidates[0][a], candidates[1][b]), 0


def _second_look(attempts, sheet: Sheet, radius: float, candidates, widths, tried: list[Attempt], path: np.ndarray | None) -> Attempt | None:
    """What `attempts` that take lines beside the device away find, starting anew; who tries so often must ask for more: clear ends, and nothing better beside."""
    more = []
    for attempt in attempts(_again(sheet, radius, candidates, widths, tried, path)):
        more.append(attempt)
        if attempt.believed and not blunt(attempt.fit).any():
            more += attempts(_beside(attempt, sheet, radius))       # the line taken away may be the device
            break
    better = lambda t: (r for r in (*tried, *more) if r.convincing and r.plain > t.plain)      # noqa: E731
    good = [t for t in more if t.convincing and not t.doubt and not blunt(t.fit).any() and all(_apart(t.fit, r.fit) < BESIDE for r in better(t))]
    return max(good, key=lambda t: (t.believed, t.weight), default=None)


def _again(sheet: Sheet, radius: float, candidates, widths, tried: list[Attempt], path: np.ndarray | None) -> Iterator[Start]:
    """Where else it may be, when no pair of lines settled it: along the (N, 3) `path` that a guess led to; where the likeliest fits came to lie, where all
    of them started, and beside the likeliest; where the other plane shows what one plane's line alone says; and the likeliest again with a search around their starts."""
    if path is not None:
        yield path, (None, None), 0
    by_weight = sorted(tried, key=lambda t: -t.weight)
    likeliest = [t for t in by_weight if t.promising][:AGAIN]
    yield from ((attempt.fit.curve(200), attempt.lines, 0) for attempt in likeliest)
    yield from ((attempt.start, attempt.lines, 0) for attempt in by_weight)
    for attempt in likeliest:
        yield from _beside(attempt, sheet, radius)
    views, dark = sheet.views, [darkness(*plane) for plane in zip(sheet.planes, sheet.fields, widths)]
    paths = []
    for k, (view, found) in enumerate(zip(views, candidates)):
        for c in found[:SWEPT]:
            path = sweep(undistort(view, c.points_px), (view, views[1 - k]), (dark[k], dark[1 - k]))
            if path is not None and path.share > SEEN:
                paths.append((np.sqrt(path.score) * path.share**2 * c.score, path.points, (c, None)[::1 - 2 * k]))
    yield from ((points, lines, 0) for _, points, lines in sorted(paths, key=lambda p: -p[0]))
    yield from ((attempt.start, attempt.lines, COARSE) for attempt in likeliest)


def _beside(attempt: Attempt, sheet: Sheet, radius: float) -> Iterator[Start]:
    """The same lines, but for the line beside them."""
    yield from ((points, attempt.lines, 0) for points in other_lines(sheet, attempt.fit, radius))


def _apart(f: Fit, g: Fit) -> float:
    """m by which a fitted curve leaves another at most."""
    return float(cKDTree(f.curve(200)).query(g.curve(200))[0].max())


def _projected(f: Fit, view) -> np.ndarray:
    """(100, 2) image pixels as received, along the fitted device."""
    return distort(view, project(view.P, f.curve(100)))


def _speaks(f: Fit, expected: bool) -> float:
    """Its evidence, for a length of 1 m; a fit with two clear ends must do without a prediction."""
    return evidence(f, expected and not clear(f)) / np.sqrt(f.stop - f.start)


def _expected(f: Fit, guess: Guess | None) -> bool:
    """Whether a prediction has the device there."""
    return guess is not None and borne_out(f.curve(100), guess)


def track(sheet: Sheet, radius: float, min_length_px: float, points: np.ndarray, coarse: int | None = 1, guess: Guess | None = None) -> Detection | None:
    """The device near where it was or should be by now, (N, 3) m; None where it is not there. `coarse`: see fit.

    Where it may be another line, the whole images must be searched, too: `sure` tells.
    """
    found = _worth_believing(sheet, fit(sheet, points, radius, coarse), min_length_px, guess)
    if found is None:
        return None
    ends, before = found.fit.curve(2), points[[0, -1]]
    jumped = min(np.linalg.norm(e - before, axis=1).max() for e in (ends, ends[::-1])) > JUMPED
    return replace(found, sure=found.sure and not jumped)


def _worth_believing(sheet: Sheet, fitted: Fit | None, min_length_px: float, guess: Guess | None) -> Detection | None:
    """A fit that no line of the images led to, if it may be believed; whether it is `sure`."""
    if fitted is None or blunt(fitted).any() or (fitted.alone >= 0).any():
        return None
    expected = _expected(fitted, guess)
    if doubt(fitted, min_length_px, expected):
        return None
    lonely = fitted.aside.max() < ASIDE or (expected and clear(fitted))
    sure = _speaks(fitted, expected) > CONVINCING and lonely and fitted.weakest.min() > MIN_WEAKEST
    return Detection(fitted, Outcome.OK, 'ok', tuple(_projected(fitted, v) for v in sheet.views), sure=bool(sure))


def found_near(sheet: Sheet, radius: float, min_length_px: float, guess: Guess) -> Detection | None:
    """The device near a guess; None where the images show none there. `sure` tells whether all of them must be searched, too.

    sheet: of images with even noise; needed only within follow.reach_px.
    """
    start = follow(sheet, guess, radius)
    if start is None or not borne_out(start, guess):
        return None
    fitted = _at_rest(sheet, fit(sheet, start, radius, 1, LOOKED_PX), radius, beyond_px=LOOKED_PX)
    found = _worth_believing(sheet, fitted, min_length_px, guess)
    if found is None or fitted.moved_px > RESTLESS_PX or not _expected(fitted, guess):
        return None
    if not clear(fitted) and max(_strayed_px(start, fitted, v) for v in sheet.views) > STRAYED_PX:
        return None
    sharp = (fitted.open_end | (fitted.end_sigma < SHARP)).all()
    return replace(found, sure=bool(found.sure and sharp and whole(fitted.stop - fitted.start, guess, sheet.views)))


def _at_rest(sheet: Sheet, fitted: Fit | None, radius: float, **options) -> Fit | None:
    """A fit from a path that may be some px off, once more where it has not come to rest. options: of fit."""
    return fitted if fitted is None or fitted.moved_px <= RESTLESS_PX else fit(sheet, fitted.curve(200), radius, 0, **options)


def _strayed_px(path: np.ndarray, f: Fit, view) -> float:
    """How far the projected (M, 3) path leaves the projected fit."""
    return float(cKDTree(project(view.P, f.curve(200))).query(project(view.P, path))[0].max())


def candidates_of(image, field, half_width_px: float, min_length_px: float) -> list[Candidate]:
    """The lines of one image that look most like a device of this width, best first; `score` is how much, at most 1."""
    lines = find_candidates(find_ridges(image, field, ridge_scale(half_width_px), shrinking(half_width_px)), min_length_px, count=LINES)
    if not lines:
        return []
    strips, of = cut_along(image, field, [line.points_px for line in lines], half_width_range(half_width_px))
    profiles, of = pieces(strips.profiles, strips.inside, of)
    alike = likeness(profiles, half_width_px)
    seen = [apparent_width([alike[of == k]]) for k in range(len(lines))]
    scored = [replace(line, score=alike_device(odd_width(width, half_width_px), alike)) for line, (width, alike) in zip(lines, seen)]
    scored.sort(key=lambda c: -c.score * np.sqrt(len(c.z)))
    return [c for c in scored[:CANDIDATES] if c.score > HOPELESS * scored[0].score]


def explained(f: Fit, view, line_px: np.ndarray, visible: np.ndarray) -> float:
    """Share of an (N, 2) undistorted centreline that lies within EXPLAINED_PX of the fitted curve's projection.

    Pieces beyond a gap in the line (`visible` (N,) false) that the curve has nothing to do with do not count: they may be another line. Nor does
    what lies past an end where the device leaves the other plane's field.
    """
    projected = project(view.P, f.spline(np.arange(f.start, f.stop, f.s[1] - f.s[0])))
    distance, nearest = cKDTree(projected).query(line_px)
    near = distance < EXPLAINED_PX
    elsewhere = ~near & (((nearest == 0) & f.open_end[0]) | ((nearest == len(projected) - 1) & f.open_end[1]))
    piece = np.cumsum(np.diff(visible.astype(int), prepend=1) == 1)
    share = np.bincount(piece, near) / np.bincount(piece)
    counted = (share[piece] > 0.2) & ~elsewhere
    return float(near[counted].mean()) if counted.any() else 0.0
