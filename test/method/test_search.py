"""The device among other lines: found, chosen by Bayes' rule, tracked, led to by a prediction, and missed by name."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluoro_shape_ros.bench.families import families
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Prior, Shape
from fluoro_shape_ros.geometry.cameras import project
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.lines import Candidate
from fluoro_shape_ros.imaging.prepare import sheet_of
from fluoro_shape_ros.method import judge, search
from fluoro_shape_ros.method.features import MEAN, TIP, features
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.method.prediction import look
from fluoro_shape_ros.method.propose.lines import Hypothesis
from fluoro_shape_ros.method.search import RESTLESS_PX, Attempt, Search, at_rest, choose, exclusive
from fluoro_shape_ros.method.tracking import tracked
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
RADIUS = 0.0006         # m
MIN_LENGTH = 60.0
LEAST = 0.9             # confidence that settles it
RIGHT, RIGHT_END = 0.08e-3, 0.4e-3      # m


def fields_of(frame):
    return [field_of_view(i) for i in frame.images]


def prepared(frame):
    return sheet_of(frame.images, fields_of(frame), frame.views, 'dark')


def mean_off(f, truth):
    return cKDTree(truth).query(f.curve(300))[0].mean()


def is_right(f, truth):
    """Which end is which is not settled here."""
    return mean_off(f, truth) < RIGHT and cKDTree(f.curve(2)).query(truth[[0, -1]])[0].max() < RIGHT_END


def never_late():
    return False


def sized_up(sheet):
    def judged(f):
        seen = features(f, sheet, RADIUS, True)
        return seen, float(judge.load().log_odds(seen)), True
    return judged


def searched(sheet, guess=None, leads=(), late=never_late, **other):
    """What was tried, and the lines."""
    found = Search(sheet, RADIUS, MIN_LENGTH,
                   **dict(judge=sized_up(sheet), settles=lambda odds: judge.load().settles(odds, LEAST)) | other,
                   guess=guess, leads=leads)
    found.go_on(late)
    return found.tried, found.lines


def never(odds):
    return False


def always(odds):
    return True


@pytest.fixture(scope='module')
def run():
    return xray_run(1, views=VIEWS, lengths=(0.06, 0.08))


@pytest.fixture(scope='module')
def scene(run):
    return run.scene()


@pytest.fixture(scope='module')
def sheet(scene):
    return prepared(scene.frame)


@pytest.fixture(scope='module')
def chosen(sheet):
    return choose(searched(sheet)[0])[0]


# ---- Bayes' rule by hand


LINE = np.c_[np.zeros((100, 2)), np.linspace(0, 0.05, 100)]


def of(odds, points=LINE):
    """An attempt that only has a curve, in pixels of 0.1 mm, its last point the tip, and odds."""
    at = lambda count: points[np.linspace(0, len(points) - 1, count).round().astype(int)]       # noqa: E731
    return Attempt(SimpleNamespace(curve=at, s=np.array([0.0, 1e-4])), (None, None), np.zeros(0), odds, True)


def likeliest(tried):
    """The chosen one, and the probability that it is right."""
    best, rivals = choose(tried)
    return best, judge.probability(best.log_odds, rivals)


@pytest.mark.parametrize('other, expected', [
    # the other way round
    (LINE, False), (LINE + [1.9 * MEAN, 0, 0], False), (LINE + [2.1 * MEAN, 0, 0], True), (LINE[::-1], True),
    (LINE[10:], False),                                                             # another base is no other answer
    (LINE[LINE[:, 2] < 0.05 - 1.4 * TIP], False), (LINE[LINE[:, 2] < 0.05 - 2.6 * TIP], True)])
def test_which_curves_exclude_one_another(other, expected):
    a, b = of(0.0), of(0.0, other)
    assert exclusive(a, b) == exclusive(b, a) == expected


def test_a_long_curve_does_not_exclude_itself_begun_a_little_later():
    """Two ways of taking points of it at even steps lie apart, along it."""
    line = np.linspace([0.0, 0, -0.25], [0.0, 0, 0.25], 2001)
    assert not exclusive(of(0.0, line), of(0.0, line[10:]))


@pytest.mark.parametrize('a, b', [(3.0, 1.0), (1.0, 3.0), (0.5, 0.5), (-2.0, -4.0)])
def test_of_two_curves_that_lie_apart_only_one_can_be_right(a, b):
    tried = [of(a), of(b, LINE + [3 * MEAN, 0, 0])]
    best, p = likeliest(tried)
    assert best.log_odds == max(a, b) and p == pytest.approx(np.exp(max(a, b)) / (1 + np.exp(a) + np.exp(b)))


def test_two_that_coincide_do_not_compete():
    best, p = likeliest([of(1.0), of(1.5, LINE + [0.5 * MEAN, 0, 0]), of(1.2, LINE[5:])])
    assert best.log_odds == 1.5 and p == pytest.approx(np.exp(1.5) / (1 + np.exp(1.5))) == judge.probability(1.5)


def test_of_rivals_that_coincide_the_likeliest_counts():
    rivals = [of(1.0, LINE + [0.005, 0, 0]), of(0.7, LINE + [0.0055, 0, 0]), of(-1.0, LINE - [0.005, 0, 0])]
    for tried in ([of(2.0), *rivals], [*rivals[::-1], of(2.0)]):
        best, p = likeliest(tried)
        assert best.log_odds == 2 and p == pytest.approx(np.exp(2) / (1 + np.exp(2) + np.exp(1) + np.exp(-1)))


def test_odds_beyond_all_measure_are_still_odds():
    assert likeliest([of(5000.0)])[1] == pytest.approx(1)
    assert likeliest([of(5000.0), of(5000.0, LINE + [0.01, 0, 0])])[1] == pytest.approx(0.5)
    assert 0 < likeliest([of(-5000.0)])[1] < 1e-9


# ---- when a search ends


def counted(monkeypatch, hypotheses, faint=()):
    """Replace what is tried by `hypotheses`, and by `faint` ones; what is returned lists the curves that are fitted,
    and whether faint lines were asked for."""
    asked, fitted, real = [], [], search.fit
    monkeypatch.setattr(search, 'candidates',
                        lambda sheet, radius, min_length_px, faint: asked.append(faint) or ([], []))
    monkeypatch.setattr(search, 'by_lines', lambda *_: iter(faint if asked[-1] else hypotheses))
    monkeypatch.setattr(search, '_again', lambda *_: iter(()))
    monkeypatch.setattr(search, 'fit', lambda sheet, points, *rest, **options: fitted.append(points)
                                                                               or real(sheet, points, *rest, **options))
    return fitted, asked


def lines(truth):
    """A candidate of each plane along the true curve; no two are the same."""
    return tuple(seen_along(project(v.P, truth)) for v in VIEWS)


def seen_along(line):
    line = at_arc_length(line, np.arange(0, arc_length(line)[-1]))
    return Candidate(line, np.ones(len(line)), 0.9)


def test_what_is_beyond_doubt_ends_the_search_but_for_the_same_lines_read_the_other_way_round(scene, sheet,
                                                                                              monkeypatch):
    same, other = lines(scene.truth), lines(scene.truth)
    hypotheses = [Hypothesis(scene.truth, same), Hypothesis(scene.truth[::-1], same), Hypothesis(scene.truth, other),
                  Hypothesis(scene.truth, same)]
    fitted, asked = counted(monkeypatch, hypotheses)
    tried, _ = searched(sheet, settles=always)
    assert len(tried) == len(fitted) == 2 and asked == [False]
    assert fitted[0] is scene.truth and fitted[1] is hypotheses[1].curve


@pytest.mark.parametrize('score, tried', [(0.9, 2), (0.5, 1)])
@pytest.mark.parametrize('ranked', [False, True])
def test_what_is_beyond_doubt_is_compared_with_what_was_proposed_nearly_as_strongly(scene, sheet, monkeypatch, score,
                                                                                    tried, ranked):
    strong = [Hypothesis(scene.truth, lines(scene.truth), score=s) for s in (1.0, score, 0.1)]
    fitted, asked = counted(monkeypatch, strong)
    searched(sheet, settles=always, first_sight=(lambda points: 0.0) if ranked else None)
    assert len(fitted) == tried and asked == [False]


def test_what_is_in_doubt_is_compared_with_everything(scene, sheet, monkeypatch):
    plain, faint = ([Hypothesis(scene.truth, lines(scene.truth)) for _ in range(n)] for n in (3, 2))
    fitted, asked = counted(monkeypatch, plain, faint)
    tried, _ = searched(sheet, settles=never)
    assert len(tried) == len(fitted) == 5 and asked == [False, True]


def test_faint_lines_are_looked_for_where_plain_ones_do_not_settle_it(scene, sheet, monkeypatch):
    off, there = (Hypothesis(scene.truth + [x, 0, 0], lines(scene.truth)) for x in (3e-4, 0.0))
    fitted, asked = counted(monkeypatch, [off], [there, off])
    searched(sheet, judge=lambda *_: (np.zeros(0), float(len(asked)), True), settles=lambda odds: odds > 1)
    assert [f is there.curve for f in fitted] == [False, True] and asked == [False, True]


def test_a_clear_line_of_one_plane_is_paired_with_a_faint_one_of_the_other(scene, sheet, monkeypatch):
    (a, b), pairs = lines(scene.truth), []
    monkeypatch.setattr(search, 'candidates',
                        lambda sheet, radius, min_length_px, faint: ([], [b]) if faint else ([a], []))
    monkeypatch.setattr(search, 'by_lines', lambda views, found: pairs.append(found) or iter(()))
    monkeypatch.setattr(search, '_again', lambda *_: iter(()))
    searched(sheet, settles=never)
    assert pairs == [([a], []), ([a], [b])]


def test_no_pair_of_lines_is_tried_twice(scene, sheet, monkeypatch):
    once, again = lines(scene.truth), lines(scene.truth)
    fitted, asked = counted(monkeypatch, [Hypothesis(scene.truth, once)],
                            [Hypothesis(scene.truth, once), Hypothesis(scene.truth, again)])
    tried, _ = searched(sheet, settles=never)
    assert [t.lines for t in tried] == [once, again] and asked == [False, True]


def test_a_lead_beyond_doubt_needs_no_search(chosen, sheet, monkeypatch):
    fitted, asked = counted(monkeypatch, [])
    tried, seen = searched(sheet, leads=[chosen.fit], settles=always)
    assert [t.fit for t in tried] == [chosen.fit] and not fitted and not asked and seen == (None, None)
    assert tried[0].lines == (None, None)


def test_a_lead_in_doubt_competes_with_what_is_found(chosen, sheet):
    part = replace(chosen.fit, stop=chosen.fit.start + 0.6 * (chosen.fit.stop - chosen.fit.start))
    tried, _ = searched(sheet, leads=[part], settles=never)
    assert tried[0].fit is part and len(tried) > 1
    best, p = likeliest(tried)
    assert best.fit is not part and p < judge.probability(best.log_odds)


def late_from(ask):
    """A clock that says that time is up when it is asked for the `ask`-th time, and from then on; and the list of its
    answers."""
    asked = []
    return lambda: asked.append(len(asked) + 1 >= ask) or asked[-1], asked


@pytest.mark.parametrize('ask, fits, looked', [(1, 0, []), (2, 0, [False]), (3, 1, [False]), (4, 2, [False]),
                                               (5, 2, [False, True]), (6, 3, [False, True])])
def test_when_time_is_up_nothing_else_is_begun(scene, sheet, monkeypatch, ask, fits, looked):
    """Asked before the plain lines, before the fit of each, before the faint lines, before the fit of each, and before
    all else."""
    plain, faint = ([Hypothesis(scene.truth, lines(scene.truth)) for _ in range(n)] for n in (2, 1))
    fitted, asked = counted(monkeypatch, plain, faint)
    late, said = late_from(ask)
    # none is fitted twice
    tried, _ = searched(sheet, settles=never, late=late, judge=lambda _: (np.zeros(0), search.HOPELESS - 1, True))
    assert (len(fitted), asked) == (fits, looked) and len(tried) == fits and said.index(True) == ask - 1


def test_nothing_is_late_where_nothing_is_left(chosen, sheet, monkeypatch):
    late, said = late_from(1)
    counted(monkeypatch, [])
    assert len(searched(sheet, leads=[chosen.fit], settles=always, late=late)[0]) == 1 and not said


def test_a_fit_that_still_moves_when_time_is_up_is_left_there(chosen, scene, sheet, monkeypatch):
    counted(monkeypatch, [Hypothesis(scene.truth, lines(scene.truth))])
    monkeypatch.setattr(search, 'fit', lambda *_, **__: replace(chosen.fit, moved_px=1.1 * RESTLESS_PX))
    for ask, count in ((3, 1), (4, 2)):
        assert len(searched(sheet, settles=never, late=late_from(ask)[0])[0]) == count


def test_what_settles_it_is_compared_with_the_other_way_round_however_late_it_is(scene, sheet, monkeypatch):
    same = lines(scene.truth)
    fitted, _ = counted(monkeypatch, [Hypothesis(scene.truth, same), Hypothesis(scene.truth[::-1], same)])
    tried, _ = searched(sheet, settles=always, late=late_from(3)[0])
    assert len(tried) == len(fitted) == 2


def test_a_search_goes_on_where_it_was_interrupted(sheet):
    def search_of():
        return Search(sheet, RADIUS, MIN_LENGTH, sized_up(sheet), never)
    whole, parts, turns = search_of(), search_of(), 0
    whole.go_on()
    while not parts.finished:
        parts.go_on(lambda: True)
        turns += 1
    assert whole.finished and turns > len(whole.tried) >= 2
    assert [t.log_odds for t in parts.tried] == [t.log_odds for t in whole.tried]
    parts.go_on()       # nothing is left
    assert len(parts.tried) == len(whole.tried)


def test_what_one_pair_shows_is_found_in_the_next(scene, sheet):
    found = Search(sheet, RADIUS, MIN_LENGTH, sized_up(sheet), lambda odds: judge.load().settles(odds, LEAST))
    found.go_on()
    assert is_right(found.likeliest(RADIUS, sheet)[0], scene.truth)


def test_lines_of_one_plane_are_not_looked_for_in_the_other_when_time_is_up(scene, sheet, monkeypatch):
    swept = []
    monkeypatch.setattr(search, 'candidates', lambda *_: tuple([c] for c in lines(scene.truth)))
    monkeypatch.setattr(search, 'by_lines', lambda *_: iter(()))
    monkeypatch.setattr(search, 'sweep', lambda *_: swept.append(1))
    guess = look(Prior(predicted=scene.truth + [0.03, 0.03, 0]), VIEWS, 0.01)[0]
    monkeypatch.setattr(search, 'follow', lambda *_, **__: None)
    for ask, count in ((4, 0), (5, 1), (9, 2)):
        del swept[:]
        searched(sheet, guess, settles=never, late=late_from(ask)[0])
        assert len(swept) == count


def test_what_is_shorter_than_asked_for_is_not_tried(chosen, sheet, monkeypatch):
    short = replace(chosen.fit, stop=chosen.fit.start + 0.9 * MIN_LENGTH * (chosen.fit.s[1] - chosen.fit.s[0]))
    counted(monkeypatch, [])
    assert searched(sheet, leads=[short])[0] == []


def test_a_fit_that_still_moves_is_fitted_once_more(chosen, sheet, monkeypatch):
    again = []
    monkeypatch.setattr(search, 'fit',
                        lambda sheet, points, radius, coarse, **options: again.append((coarse, options)) or chosen.fit)
    resting, moving = (replace(chosen.fit, moved_px=by * RESTLESS_PX) for by in (0.9, 1.1))
    assert (at_rest(sheet, resting, RADIUS, clearing=True) is resting
            and at_rest(sheet, None, RADIUS) is None and not again)
    assert at_rest(sheet, moving, RADIUS, clearing=True) is chosen.fit and again == [(0, dict(clearing=True))]


def test_where_it_may_go_on_in_a_bend_both_are_tried_and_bends_come_to_an_end(chosen, scene, sheet, monkeypatch):
    bend, given = scene.truth + [0, 0, 1e-4], []
    counted(monkeypatch, [Hypothesis(scene.truth, lines(scene.truth))])
    monkeypatch.setattr(search, 'fit', lambda sheet, points, *_, **__: given.append(points)
                                                                       or replace(chosen.fit, bent=bend))
    tried, _ = searched(sheet, settles=never)
    assert [g is bend for g in given] == [False] + [True] * search.BENDS and len(tried) == len(given)


# ---- on images


def test_the_device_is_found_in_front_of_anatomy(scene, chosen):
    assert is_right(chosen.fit, scene.truth)


def test_what_was_seen_lies_on_the_device(scene, sheet, chosen):
    answer = reconstruct(scene.frame, Config.from_values(robot_radius=RADIUS, min_confidence=0.0))
    for view, line, shown in zip(VIEWS, chosen.lines, answer.centerlines):
        true = cKDTree(project(view.P, scene.truth))
        for points in (line.points_px, shown.points_px):
            assert np.median(true.query(points)[0]) < 1.0 and len(points) > 100


def test_without_a_device_the_plane_is_named():
    plain = xray_run(1, views=VIEWS, lengths=(0.06, 0.08), anatomy=False)
    there, gone = plain.scene().frame, plain.without_device()
    for images, outcome in (((gone.images[0], there.images[1]), Outcome.NO_DEVICE_A),
                            ((there.images[0], gone.images[1]), Outcome.NO_DEVICE_B),
                            (gone.images, Outcome.NO_DEVICE_A)):
        frame = replace(there, images=images)
        tried, seen = searched(prepared(frame))
        assert not tried and [s is None for s in seen] == [i is not j for i, j in zip(images, there.images)]
        result = reconstruct(frame, Config.from_values(robot_radius=RADIUS))
        assert result.outcome is outcome and result.detail and np.isnan(result.confidence)
        assert [line is None for line in result.centerlines] == [s is None for s in seen]


def test_lines_that_share_no_epipolar_lines_do_not_correspond():
    plain = xray_run(1, views=VIEWS, lengths=(0.06, 0.08), anatomy=False).scene().frame
    rolled = np.roll(plain.images[1], 230, axis=0)      # the device stands nearly half the image lower there
    frame = replace(plain, images=(plain.images[0], rolled))
    result = reconstruct(frame, Config.from_values(robot_radius=RADIUS))
    assert (result.outcome in (Outcome.NO_CORRESPONDENCE, Outcome.LOW_CONFIDENCE, Outcome.REPROJECTION)
            and not result.confidence > 0.5)


def test_a_line_that_is_half_another_in_one_plane_is_looked_for_anew(scene, sheet, monkeypatch):
    """In plane a the device; in plane b its first half, going on straight as a lead might."""
    a, b = (project(v.P, scene.truth) for v in VIEWS)
    half = len(b) // 2
    step = b[half] - b[half - 1]
    b = np.concatenate([b[:half], b[half] + np.arange(len(b) - half)[:, None]
                                  * (step + np.linalg.norm(step) * np.array([0.5, 0]))])
    monkeypatch.setattr(search, 'candidates', lambda *_: ([seen_along(a)], [seen_along(b)]))
    tried, seen = searched(sheet, settles=never)
    assert is_right(choose(tried)[0].fit, scene.truth)
    assert cKDTree(a).query(seen[0])[0].max() < 1


@pytest.mark.parametrize('seed', [10018, 10027])
def test_lines_along_epipolar_lines_fit_both_ways_round_and_both_count(seed):
    scene = families()['tangent'].make(seed).scene
    truth = scene.truth
    answer = reconstruct(scene.frame, Config.from_values(robot_radius=scene.radius, base_position=truth[0].tolist()))
    if answer.outcome is Outcome.OK:
        # the wrong way round is some mm off; the base, along the epipolar line, is known to 1 mm only
        off = cKDTree(truth).query(answer.shape.points)[0]
        assert off.mean() < 0.1e-3 and off[-20:].max() < 0.5e-3 and off.max() < 1e-3
    else:
        assert answer.outcome is Outcome.LOW_CONFIDENCE and answer.confidence < Config().plausibility.min_confidence


# ---- near where it was


def shape(points):
    return Shape(points, arc_length(points), np.zeros((len(points), 3, 3)), np.zeros((len(points), 2)))


def track(frame, points):
    return tracked(frame, frame.images, fields_of(frame), 'dark', RADIUS, Prior(previous=shape(points)))


def test_tracking_goes_on_from_where_the_device_was(scene, chosen):
    found = track(scene.frame, scene.truth + [0.3e-3, -0.3e-3, 0.3e-3])
    assert found.alone and is_right(found.fit, scene.truth) and mean_off(found.fit, chosen.fit.curve(300)) < RIGHT_END
    # it looked at no more than a region
    assert all(p.size < i.size for p, i in zip(found.sheet.planes, scene.frame.images))


def test_what_is_tracked_where_the_device_is_not_asks_for_a_search(scene):
    found = track(scene.frame, scene.truth + [0.02, 0.0, 0.0])
    assert found is None or not found.alone or not judge.load().settles(sized_up(found.sheet)(found.fit)[1], LEAST)


def test_an_end_that_jumped_asks_for_a_search(scene):
    gone_on = track(scene.frame, scene.truth[:-60])       # the tip was 6 mm short of where it is found now
    assert is_right(gone_on.fit, scene.truth) and not gone_on.alone
    assert track(scene.frame, scene.truth[:-30]).alone


def test_what_reaches_the_edge_of_the_region_may_go_on_beyond_it(scene):
    assert track(scene.frame, scene.truth[:len(scene.truth) // 4]) is None


# ---- led by a prediction


def test_where_no_lines_belong_together_a_prediction_leads_to_the_device(scene, sheet, monkeypatch):
    monkeypatch.setattr(search, 'by_lines', lambda *_: iter(()))
    monkeypatch.setattr(search, 'sweep', lambda *_: None)
    bent = scene.truth + [[0, 0, 0.004]] * np.linspace(0, 1, len(scene.truth))[:, None] ** 2
    assert searched(sheet)[0] == []
    tried, _ = searched(sheet, look(Prior(predicted=bent), VIEWS, 0.01)[0])
    assert is_right(choose(tried)[0].fit, scene.truth)
    assert searched(sheet, look(Prior(predicted=bent + [0.03, 0.03, 0]), VIEWS, 0.01)[0])[0] == []


def test_where_no_lines_were_seen_a_prediction_leads_to_the_device(scene, sheet, monkeypatch):
    monkeypatch.setattr(search, 'candidates', lambda *_: ([], []))
    tried, seen = searched(sheet, look(Prior(predicted=scene.truth), VIEWS, 0.01)[0])
    assert is_right(choose(tried)[0].fit, scene.truth) and seen == (None, None)
