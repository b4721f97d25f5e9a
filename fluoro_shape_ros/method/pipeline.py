"""A pair of images walks straight through: prepare, propose, fit, judge, decide the tip, answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from ..config import Config
from ..data import Centerline, Frame, Outcome, Prior, Reconstruction, Searched, Shape, View
from ..geometry.cameras import GeometryError, check, distort, pixels_per_metre, project, undistort
from ..geometry.curve import arc_length, distance_to, resample
from ..imaging.field import border_distance, common_field
from ..imaging.mask import subtract
from ..imaging.parallel import both
from ..imaging.prepare import dark_device, sheet_of, silhouettes
from ..imaging.strips import Sheet
from . import judge, paper
from .backbone import backbone
from .continuity import continuity
from .features import MEAN, MEAN_PX, TIP, TIP_PX, at_first_sight, features
from .fit.fit import fit
from .fit.result import Fit
from .known_device import ALIKE, CONTRADICTS, Likeness, likeness, verdict
from .landmarks import landmarks
from .outline import on_outlines
from .prediction import Guess, borne_out, informed, judged, look
from .search import Attempt, Search, choose, projected
from .tip import tip_of
from .tracking import Near, predicted, tracked
from .user_bounds import check_curvature, check_length, check_reprojection, check_tip, curvature_limit

BORDER_PX = 12.0        # an end this near to the field's border runs out of it
RATHER = 0.5            # confidence below which a curve is rather wrong than right
CURVE = 400             # points of a fit, that its darkness is looked at along
# what a longer search might have answered
OPEN = {Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B, Outcome.NO_CORRESPONDENCE, Outcome.LOW_CONFIDENCE}


def reconstruct(frame: Frame, config: Config, prior: Prior = Prior(), until: float | None = None) -> Reconstruction:
    """The backbone seen in a pair of images, or the reason why there is none. Pure: the same pair gives the same
    answer.

    until: time.monotonic() from which on no other hypothesis is tried, and what was found by then is judged; None: no
    limit, and the same answer on any machine.
    """
    clock = _Stopwatch(until)
    try:
        check(frame.views, config.radius)
    except GeometryError as error:
        return Reconstruction(Outcome.BAD_GEOMETRY, str(error))
    by: Callable[..., Reconstruction] = _by_paper if config.curve.method == 'paper' else _by_spline
    if config.detection.image_kind == 'silhouette':
        images, fields, outlines = silhouettes(frame.images, frame.views, config.radius)
        config = config.replace(polarity='dark')
        by = by if by is _by_paper else partial(by, measured=partial(on_outlines, outlines, radius=config.radius))
    else:
        images = frame.images if prior.masks is None else tuple(subtract(i, m)
                                                                for i, m in zip(frame.images, prior.masks))
        fields = both(partial(common_field, polarity=config.detection.polarity), frame.images,
                      prior.masks or (None, None),
                      pixels=sum(image.size for image in frame.images) // 4)     # it halves them first
    clock.lap('prepare')
    guess, why = look(prior, frame.views, config.curve.prior_sigma)
    return judged(_in_time(by(frame, images, fields, config, prior, guess, clock), clock), guess, why)


def _by_spline(frame: Frame, images: Sequence[np.ndarray], fields: Sequence[np.ndarray], config: Config, prior: Prior,
               guess: Guess | None, clock: _Stopwatch, measured: Callable[[Fit], Fit] = lambda f: f) -> Reconstruction:
    """method:=spline: both images are fitted at once, from where the device was or is predicted to be, or from a search
    of the whole images.

    measured: what is made of a Fit before it is judged.
    """
    radius, polarity, least = config.radius, config.detection.polarity, config.plausibility.min_confidence
    tip = partial(_tip, frame, fields, config, prior, guess)
    model = judge.load()

    def sized_up(sheet: Sheet, f: Fit) -> tuple[np.ndarray, float, bool]:
        """Features of a fit and its log odds, with what a prediction that it bears out, the device's description and
        where it was say; and whether its last end is the tip."""
        alike = _alike(f.curve(CURVE), sheet, config)
        last, _ = tip(f, alike)
        seen = features(f, sheet, radius, last)
        predicted = judge.PREDICTED if guess is not None and borne_out(f.curve(100), guess) else 0.0
        was = continuity(f.curve(100), prior, frame.stamp_ns)
        return seen, float(model.log_odds(seen)) + predicted + verdict(config.described, alike, f, last)[0] + was, last

    lines: Sequence[np.ndarray | None] = ()
    leads, chosen, unfinished, searched = [], None, None, prior.searched
    for n in _near(frame, images, fields, config, prior, guess, clock):
        f = measured(n.fit)
        attempt = Attempt(f, (None, None), *sized_up(n.sheet, f))
        if n.alone and (guess is None or borne_out(f.curve(100), guess)):
            stands = _stands(attempt.log_odds, model, least, searched)
            if stands is not None:
                chosen, p, sheet = attempt, stands, n.sheet
                break
        leads.append(f)
    if chosen is None:
        sheet = sheet_of(images, fields, frame.views, polarity)
        sized = partial(sized_up, sheet)
        if prior.search is None or guess is not None:
            search = Search(sheet, radius, config.detection.min_length_px, sized,
                            lambda odds: model.settles(odds, max(least, judge.BEYOND_DOUBT)), guess, leads,
                            lambda points: float(model.log_odds(at_first_sight(points, sheet, radius))), measured)
            search.go_on(clock.late)
            tried = search.tried
        else:       # one that an earlier pair had no time for; what it finds there is looked for here
            search = prior.search
            search.go_on(clock.late)
            leads += map(measured, search.likeliest(radius, sheet) if search.finished else [])
            tried = [Attempt(f, (None, None), *sized(f)) for f in leads]
        lines, unfinished = search.lines, None if search.finished else search
        clock.lap('search')
        if not tried:
            return replace(_nothing(lines, config, clock), search=unfinished)
        chosen, rivals = choose(tried)
        p = judge.probability(chosen.log_odds, rivals)
        searched = Searched(chosen.log_odds, rivals) if search.finished else None

    f, confidence = chosen.fit, model.confidence(p)
    if confidence < min(least, RATHER) and any(line is None for line in lines):
        return replace(_nothing(lines, config, clock), confidence=confidence, search=unfinished)
    seen = tuple(Centerline(projected(f, v) if c is None else c.points_px) for v, c in zip(frame.views, chosen.lines))
    alike = _alike(f.curve(CURVE), sheet, config)
    last, guessed = tip(f, alike)
    against, words = verdict(config.described, alike, f, last, config.detection.device)
    if against > min(CONTRADICTS, model.terms(chosen.features).min()):
        words = model.why(chosen.features, chosen.log_odds, p)
    if continuity(f.curve(100), prior, frame.stamp_ns) < min(model.terms(chosen.features).min(), against):
        words = 'it is far from where it was just before'
    if guess is not None and borne_out(f.curve(100), guess):
        f = informed(f, guess)
    shape, places = backbone(f, frame.views, last, config.curve.backbone_spacing), landmarks(f, frame.views, last)
    clock.lap('backbone')
    doubt = (Outcome.LOW_CONFIDENCE, words) if confidence < least else _doubt(shape, config, frame)
    if doubt:
        return Reconstruction(*doubt, centerlines=seen, stage_seconds=clock.laps, confidence=confidence,
                              search=unfinished, searched=searched, landmarks=places)
    return Reconstruction(Outcome.OK, 'ok', shape, ('tip_ambiguous',) if guessed else (), seen, clock.laps,
                          confidence=confidence, searched=searched, landmarks=places)


def _stands(log_odds: float, model: judge.Judge, least: float, searched: Searched | None) -> float | None:
    """The probability that a curve near where the device was is right, if no search of whole images is called for: it
    is beyond doubt by itself, or about as likely as when one was made, beside what else that found. Else None."""
    if model.settles(log_odds, max(least, judge.STILL_THERE)):
        return judge.probability(log_odds)
    if searched is None or log_odds < searched.log_odds - judge.FLUCTUATES:
        return None
    p = judge.probability(log_odds, searched.rivals)
    return p if model.confidence(p) >= RATHER else None     # if it is refused, another search would refuse it, too


def _near(frame: Frame, images: Sequence[np.ndarray], fields: Sequence[np.ndarray], config: Config, prior: Prior,
          guess: Guess | None, clock: _Stopwatch) -> Iterator[Near]:
    """The device where it was, or should be by now, then where a prediction has it."""
    here = frame, images, fields, config.detection.polarity, config.radius
    if config.curve.tracking and prior.previous is not None:
        found = tracked(*here, prior)
        clock.lap('track')
        if found is not None:
            yield found
    if guess is not None and not clock.late():
        found = predicted(*here, guess)
        clock.lap('follow')
        if found is not None:
            yield found


def _in_time(result: Reconstruction, clock: _Stopwatch) -> Reconstruction:
    """The same, or out of time where the clock cut the search short and it might have gone otherwise."""
    if not clock.cut_short or result.outcome not in OPEN:
        return result
    found = (f'the likeliest curve by then: {result.detail}'
             if result.outcome is Outcome.LOW_CONFIDENCE else 'no curve was found by then')
    return replace(result, outcome=Outcome.OUT_OF_TIME, detail=found)


def _nothing(lines: Sequence[np.ndarray | None], config: Config, clock: _Stopwatch) -> Reconstruction:
    """The answer where no curve was found that both planes show."""
    seen = tuple(None if px is None else Centerline(px) for px in lines)
    for px, outcome in zip(lines, (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)):
        if px is None:
            return Reconstruction(outcome, f'no line of at least {config.detection.min_length_px:g} px stands out',
                                  centerlines=seen, stage_seconds=clock.laps)
    return Reconstruction(Outcome.NO_CORRESPONDENCE, 'no line of plane a is one of plane b', centerlines=seen,
                          stage_seconds=clock.laps)


def _by_paper(frame: Frame, images: Sequence[np.ndarray], fields: Sequence[np.ndarray], config: Config, prior: Prior,
              guess: Guess | None, clock: _Stopwatch) -> Reconstruction:
    """method:=paper: segment each image, correspond, triangulate, and believe eq. 3."""
    images = [dark_device(image, config.detection.polarity) for image in images]
    widths = paper.half_width_px(frame.views, config)
    seen = tuple(_centerline(paper.segment(image, width, config.detection.min_length_px), field, width)
                 for image, field, width in zip(images, fields, widths))
    clock.lap('segment')
    for line, outcome in zip(seen, (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)):
        if line is None:
            return Reconstruction(outcome, f'no curve of at least {config.detection.min_length_px:g} px',
                                  centerlines=seen, stage_seconds=clock.laps)

    curves = paper.reconstruct_curves(frame.views, tuple(line.points_px for line in seen), config.detection.spacing_px)
    clock.lap('triangulate')
    if min(map(len, curves)) < 3:
        return Reconstruction(Outcome.NO_CORRESPONDENCE, f'{len(curves[0])} and {len(curves[1])} corresponding points',
                              centerlines=seen, stage_seconds=clock.laps)

    best = max(curves, key=lambda c: arc_length(c)[-1])
    metres_per_px = 1 / float(np.mean([pixels_per_metre(v.P, best) for v in frame.views]))
    sheet = sheet_of(images, fields, frame.views, 'dark')
    forward, guessed = tip_of(best[[0, -1]], _at_border(best[[0, -1]], frame.views, seen), frame.views, fields, config,
                              _known_order(best, prior, guess), _alike(best, sheet, config))
    points, s = resample(best if forward else best[::-1], config.curve.backbone_spacing)
    residuals = residuals_px(points, frame.views, seen)
    clock.lap('curve')

    doubt = (check_curvature(curves, curvature_limit(config, metres_per_px)) or check_length(s[-1], config)
             or check_reprojection(residuals, config))
    clock.lap('plausibility')
    confidence = _confidence_of(points, sheet, config)
    if doubt:
        return Reconstruction(*doubt, centerlines=seen, stage_seconds=clock.laps, confidence=confidence)
    # the published method knows no covariance
    shape = Shape(points, s, np.full((len(points), 3, 3), np.nan), residuals)
    return Reconstruction(Outcome.OK, 'ok', shape, ('tip_ambiguous',) if guessed else (), seen, clock.laps,
                          confidence=confidence)


def _confidence_of(points: np.ndarray, sheet: Sheet, config: Config) -> float:
    """The probability that a backbone (N, 3) of dark devices is right, which a fit did not make: that of the fit which
    begins there, if they are one curve."""
    f = fit(sheet, points, config.radius, 1)
    if f is None:
        return 0.0
    model, ends = judge.load(), f.curve(2)
    last = bool(np.linalg.norm(ends[1] - points[-1]) < np.linalg.norm(ends[0] - points[-1]))
    px = f.s[1] - f.s[0]
    if (distance_to(points, f.curve(400)).mean() > max(MEAN, MEAN_PX * px)
            or np.linalg.norm(ends[int(last)] - points[-1]) > max(TIP, TIP_PX * px)):
        return 0.0
    return model.confidence(judge.probability(float(model.log_odds(features(f, sheet, config.radius, last)))))


def _doubt(shape: Shape, config: Config, frame: Frame) -> tuple[Outcome, str] | None:
    """What a user has set a bound to, if the backbone is beyond it."""
    metres_per_px = 1 / float(np.mean([pixels_per_metre(v.P, shape.points) for v in frame.views]))
    return (check_curvature([shape.points[::4]], curvature_limit(config, metres_per_px))
            or check_length(shape.length, config)
            or check_reprojection(shape.residuals_px, config) or check_tip(shape.covariance[-1], config))


def _tip(frame: Frame, fields: Sequence[np.ndarray], config: Config, prior: Prior, guess: Guess | None, f: Fit,
         alike: Callable[[], Likeness]) -> tuple[bool, bool]:
    """Whether the last end of a fit is the tip, and whether that is a guess."""
    return tip_of(f.curve(2), tuple(f.open_end), frame.views, fields, config,
                  _known_order(f.curve(100), prior, guess), alike)


def _alike(points: np.ndarray, sheet: Sheet, config: Config) -> Callable[[], Likeness]:
    """What the device's description says of the (N, 3) points of a curve, worked out once it is asked for; silhouettes
    tell nothing, they are equally dark all along."""
    if config.described is None or config.detection.image_kind == 'silhouette':
        return lambda: ALIKE
    return cache(partial(likeness, config.described, points, sheet, config.radius))


def residuals_px(points: np.ndarray, views: Sequence[View], centerlines: Sequence[Centerline]) -> np.ndarray:
    """(N, 2) distance in px of the reprojected (N, 3) points to the centreline seen in each plane."""
    return np.stack([distance_to(project(v.P, points), undistort(v, line.points_px))
                     for v, line in zip(views, centerlines)], axis=1)


def _centerline(points_px: np.ndarray, field: np.ndarray, half_width_px: float) -> Centerline | None:
    if len(points_px) < 2:
        return None
    first, last = border_distance(field, points_px[[0, -1]]) < BORDER_PX
    return Centerline(points_px, 2 * half_width_px, (bool(first), bool(last)))


def _at_border(ends: np.ndarray, views: Sequence[View], seen: Sequence[Centerline]) -> tuple[bool, bool]:
    """Whether each of a backbone's two ends belongs to a centreline's end at the field's border, in either plane."""
    at_border = np.zeros(2, bool)
    for line, view in zip(seen, views):
        for k, end in enumerate(distort(view, project(view.P, ends))):
            at_border[k] |= line.at_border[np.linalg.norm(line.points_px[[0, -1]] - end, axis=1).argmin()]
    return bool(at_border[0]), bool(at_border[1])


def _known_order(points: np.ndarray, prior: Prior, guess: Guess | None) -> np.ndarray | None:
    """(N, 3) a curve known to run from base to tip, m: the previous result, else the prediction if the (N, 3) points
    found bear it out."""
    if prior.previous is not None:
        return prior.previous.points
    return guess.points if guess is not None and borne_out(points, guess) else None


class _Stopwatch:
    """Wall time of each stage, s, and whether something was left undone because time was up."""

    def __init__(self, until: float | None):
        self.laps: dict[str, float] = {}
        self.cut_short = False
        self._until, self._last = until, time.perf_counter()

    def late(self) -> bool:
        """Whether time is up; who asks leaves undone what is left."""
        self.cut_short = self._until is not None and time.monotonic() >= self._until
        return self.cut_short

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
