"""The calibrated model by hand, what the package's own must keep to whatever its numbers are, and how it is learnt."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.bench import judge as bench_judge
from fluoro_shape_ros.bench import main
from fluoro_shape_ros.bench.families import Sources
from fluoro_shape_ros.bench.judge import LEAST, Curves, calibrate, chosen_of, is_right, learn
from fluoro_shape_ros.bench.score import Answer
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.method import judge
from fluoro_shape_ros.method.features import MEAN, MEAN_PX, NAMES, TIP
from fluoro_shape_ros.method.judge import FAR, LIMIT, NEAR, REASONS, SIGNS, judge_of, probability
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.resources import resource_path

N = len(NAMES)
SIGN = np.array([SIGNS[n] for n in NAMES])
EVERY = dict.fromkeys(NAMES, 1.0)


# some features, the first two of different sign
A, B, C = next(n for n in NAMES if SIGNS[n] > 0), next(n for n in NAMES if SIGNS[n] < 0), NAMES[-1]


def by_hand(bias=0.0, offset=0.0, slope=1.0, far={}, **near):       # noqa: B006 (never changed)
    """A judge of features that are typically 0 with scale 1, of which some count."""
    terms = {n: dict(typical=0.0, scale=1.0, near=near.get(n, 0.0), far=far.get(n, 0.0)) for n in NAMES}
    return judge_of(dict(bias=bias, features=terms, offset=offset, slope=slope))


def worse(**scales):
    """(N,) features that are so many scales worse than 0, by name; better where that is negative."""
    return -SIGN * [scales.get(n, 0.0) for n in NAMES]


def share(z):
    return 1 / (1 + np.exp(-np.asarray(z)))


# ---- by hand


def test_a_feature_counts_by_how_much_worse_than_typical_it_is():
    model = replace(by_hand(2.0, **{A: 3.0, B: 1.0}, far={B: 0.5}), typical=worse(**{B: 0.2}),
                    scale=np.where(np.array(NAMES) == A, 2.0, 1.0))
    assert model.log_odds(model.typical) == model.log_odds(worse(**{A: 2 * NEAR, B: 0.2 + 0.99 * NEAR})) == 2
    assert_allclose(model.log_odds(worse(**{A: 2 * (NEAR + 0.5), B: 0.2})), 2 - 3 * 0.5)
    assert_allclose(model.log_odds(worse(**{B: 0.2 + FAR})), 2 - (FAR - NEAR))
    assert_allclose(model.log_odds(worse(**{B: 1.2 + FAR})), 2 - (1 + FAR - NEAR) - 0.5)
    assert_allclose(model.log_odds(np.stack([worse(**{B: 0.2 + FAR}), worse(**{B: 0.2})])), [2 - (FAR - NEAR), 2])


def test_nothing_makes_up_for_what_speaks_against_a_curve():
    model, good = by_hand(2.0, **EVERY), dict.fromkeys(NAMES, -5.0)
    assert model.log_odds(worse(**good)) == 2
    assert_allclose(model.log_odds(worse(**good | {B: NEAR + 1.5})), 2 - 1.5)


def test_what_is_far_off_says_no_more():
    model = by_hand(**{A: 1.0})
    assert_allclose([model.log_odds(worse(**{A: x})) for x in (1e9, LIMIT + 0.1)], NEAR - LIMIT)


@pytest.mark.parametrize('name', NAMES)
def test_why_names_what_speaks_most_against_it(name):
    model, features = by_hand(5.0, **EVERY), worse(**dict.fromkeys(NAMES, NEAR + 1) | {name: NEAR + 2})
    given = float(model.log_odds(features))
    assert model.why(features, given, probability(given)) == REASONS[name]


def test_why_names_a_rival_that_takes_half_of_the_probability():
    model, features = by_hand(**{A: 1.0}), worse(**{A: 2.0})
    assert model.why(features, 3.0, 0.51 * probability(3.0)) == REASONS[A]
    assert 'another curve' in model.why(features, 3.0, 0.49 * probability(3.0))


def test_confidence_by_hand():
    assert by_hand().confidence(0.7) == pytest.approx(0.7)
    assert by_hand(offset=1.0, slope=0.5).confidence(0.8) == pytest.approx(share(1 + 0.5 * np.log(4)))
    assert probability(0.0) == 0.5 and probability(np.log(3)) == pytest.approx(0.75)


def test_it_settles_what_alone_has_the_confidence_asked_for():
    model = by_hand(offset=-1.0, slope=2.0)
    assert model.settles(0.501, 0.5) and not model.settles(0.499, 0.5)
    assert model.settles(2.0, share(2.999)) and not model.settles(2.0, share(3.001))


# ---- the package's own


@pytest.fixture(scope='module')
def model():
    return judge.load()


def test_every_feature_has_a_sign_and_words_and_stands_in_the_file():
    content = json.loads(resource_path('judge.json').read_text(encoding='utf-8'))
    assert set(NAMES) == set(SIGNS) == set(REASONS) == set(content['features'])
    assert set(SIGNS.values()) == {-1, 1}
    assert len(set(REASONS.values())) == N and not any('\n' in why or why.endswith('.') for why in REASONS.values())
    numbers = [content[k] for k in ('bias', 'offset', 'slope')] + [x for t in content['features'].values()
                                                                   for x in t.values()]
    assert np.isfinite(numbers).all() and all(t['scale'] > 0 <= min(t['near'], t['far'])
                                              for t in content['features'].values())
    assert 'seed' in json.dumps(content)        # where it comes from


def random_features(model, count, seed=0):
    return model.typical + np.random.default_rng(seed).normal(0, 3, (count, N)) * model.scale


def test_terms_sum_up(model):
    features = random_features(model, 200)
    assert_allclose(model.log_odds(features), model.bias + model.terms(features).sum(axis=1))
    assert_allclose([model.log_odds(f) for f in features[:5]], model.log_odds(features)[:5])
    assert model.log_odds(model.typical) == model.bias == model.log_odds(features).max(initial=model.bias)


@pytest.mark.parametrize('name', NAMES)
def test_the_odds_rise_or_fall_with_every_feature_as_its_sign_says(model, name):
    k, features = NAMES.index(name), random_features(model, 300)
    more = features.copy()
    more[:, k] += np.random.default_rng(1).exponential(2, 300) * model.scale[k]
    assert (SIGNS[name] * (model.log_odds(more) - model.log_odds(features)) >= -1e-9).all()


def test_a_typical_right_fit_is_believed_and_one_that_is_worse_in_all_respects_is_not(model):
    assert model.confidence(probability(model.log_odds(model.typical))) > 0.9
    assert model.confidence(probability(model.log_odds(model.typical - LIMIT * SIGN * model.scale))) < 0.05


def test_confidence_is_a_probability_that_grows_with_the_odds(model):
    p = [0.0, 1e-15, 1e-6, 0.01, 0.3, 0.5, 0.9, 0.9999, 1.0]
    confidence = [model.confidence(x) for x in p]
    assert ((np.diff(confidence[2:-1]) > 0).all() and (np.diff(confidence) >= 0).all() and 0 < confidence[0]
            and confidence[-1] < 1)
    certain = [model.settles(z, 0.9) for z in np.linspace(-50, 50, 1001)]
    assert not certain[0] and certain[-1] and np.count_nonzero(np.diff(certain)) == 1


# ---- learning


WORTH = {A: 2.0, B: 1.0}            # what each scale worse costs in the world that the scenes are drawn from
BIAS = 2.0


def scenes(count, each=1, first=0, rng=0, worth=WORTH):
    """So many scenes with `each` curves of normal features, right with ln odds BIAS less what is worse than 0 costs;
    seeds from `first`."""
    rng = np.random.default_rng(rng)
    return [Curves('drawn', first + k, True, x, rng.random(each) < share(true_log_odds(x, worth)),
                   ~np.eye(each, dtype=bool))
            for k, x in enumerate(rng.normal(0, 2, (count, each, N)))]


def true_log_odds(features, worth=WORTH):
    return by_hand(BIAS, **worth).log_odds(features)


@pytest.fixture(scope='module')
def learnt():
    return judge_of(learn(scenes(8000)))


def test_a_logistic_model_is_learnt_from_what_it_made(learnt):
    features = np.concatenate([s.features for s in scenes(3000, first=10**6, rng=7)])
    assert np.sqrt(np.mean((share(learnt.log_odds(features)) - share(true_log_odds(features)))**2)) < 0.05
    weights = dict(zip(NAMES, learnt.near / learnt.scale))
    assert min(weights[n] / w for n, w in WORTH.items()) > 0.5      # the hinge is not quite where it was
    assert max(w for n, w in weights.items() if n not in WORTH) < 0.15
    assert_allclose([learnt.offset, learnt.slope], [0, 1], atol=0.15)


def test_what_is_learnt_is_honest_on_scenes_that_it_has_not_seen(learnt):
    found = [(learnt.confidence(p), right)
             for p, right in (chosen_of(learnt, s) for s in scenes(4000, first=10**6, rng=8))]
    confidence, right = np.array(found).T
    for low, high in ((0.0, 0.3), (0.3, 0.7), (0.7, 1.0)):
        among = (confidence > low) & (confidence < high)
        assert among.sum() > 100 and abs(right[among].mean() - confidence[among].mean()) < 0.05


def test_no_feature_counts_against_its_sign():
    x, k = scenes(3000, worth={C: 2.0}), NAMES.index(C)
    turned = [replace(s, features=np.where(np.arange(N) == k, -s.features, s.features)) for s in x]
    with_it, against_it = (judge_of(learn(given)) for given in (x, turned))
    assert with_it.near[k] + with_it.far[k] > 0.5 and against_it.near[k] == against_it.far[k] == 0
    assert all((j.near >= 0).all() and (j.far >= 0).all() for j in (with_it, against_it))


def test_learning_is_deterministic_and_does_not_care_for_scenes_where_nothing_was_tried():
    x = scenes(1500, each=2)
    nothing = Curves('drawn', 17, False, np.empty((0, N)), np.empty(0, bool), np.empty((0, 0), bool))
    assert learn(x) == learn(x) == learn([*x, nothing])


def test_the_more_curves_were_tried_in_a_scene_the_less_each_counts():
    """Wrong curves four times over are no more than twice as much: the odds fall by ln 2 at most, not by ln 4."""
    x = scenes(3000)
    again = [s if s.right[0] else replace(s, features=s.features.repeat(4, axis=0), right=s.right.repeat(4),
                                          clash=np.zeros((4, 4), bool)) for s in x]
    once, often = (judge_of(learn(given)) for given in (x, again))
    assert_allclose(once.bias - often.bias, np.log(2), atol=0.2)


def test_what_it_was_learnt_from_is_said():
    x = scenes(1000, each=2, first=300)
    said = json.dumps(learn(x))
    assert '300' in said and '1299' in said and str(sum(int(s.right.sum()) for s in x)) in said
    assert judge_of(json.loads(said)).log_odds(np.zeros(N)) == judge_of(learn(x)).log_odds(np.zeros(N))


def test_too_few_curves_are_refused():
    with pytest.raises(ValueError, match=f'too few to learn from: {LEAST} of each'):
        learn(scenes(LEAST))
    for right in (True, False):
        with pytest.raises(ValueError, match='0 wrong' if right else '^0 right'):
            learn([replace(s, right=np.full_like(s.right, right)) for s in scenes(2 * LEAST)])


@pytest.mark.parametrize('by', [3.0, 0.4])
def test_calibration_mends_a_judge_that_is_too_sure_or_too_modest(by):
    """True log odds z, claimed ones 1 + by z: the mended ones are (claimed - 1) / by."""
    rng = np.random.default_rng(3)
    z = rng.normal(0, 2.5, 6000)
    claimed, right = share(1 + by * z), rng.random(6000) < share(z)
    offset, slope = calibrate(list(zip(claimed, right)))
    assert_allclose([offset, slope], [-1 / by, 1 / by], rtol=0.15)
    for model, honest in ((by_hand(), False), (by_hand(offset=offset, slope=slope), True)):
        off = np.array([model.confidence(p) for p in claimed]) - share(z)
        assert (np.sqrt(np.mean(off**2)) < 0.02) == honest


def test_of_curves_that_lie_apart_one_is_chosen_by_bayes_rule():
    """Odds 1, e and e^2; the first coincides with the third, so that it does not compete."""
    model, features = by_hand(2.0, **{A: 1.0}), np.stack([worse(**{A: v}) for v in (NEAR + 2, NEAR + 1, 0.0)])
    x = Curves('drawn', 0, True, features, np.array([False, False, True]),
               np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool))
    p, right = chosen_of(model, x)
    assert right and p == pytest.approx(np.e**2 / (1 + np.e + np.e**2))
    p, right = chosen_of(model, replace(x, clash=~np.eye(3, dtype=bool), right=np.array([True, True, False])))
    assert not right and p == pytest.approx(np.e**2 / (2 + np.e + np.e**2))


def test_right_is_as_near_as_the_confidence_promises():
    line = np.c_[np.zeros((200, 2)), np.linspace(0, 0.05, 200)]
    until = lambda lost: line[line[:, 2] < 0.05 - lost]     # noqa: E731
    assert all(is_right(points, line, 1e-4) for points in (line, line + [0.9 * MEAN, 0, 0], until(0.7 * TIP)))
    assert not any(is_right(points, line, 1e-4) for points in (line[::-1], line + [1.1 * MEAN, 0, 0], until(1.3 * TIP)))
    assert is_right(line + [1.5 * MEAN, 0, 0], line, 2 * MEAN / MEAN_PX)    # a px at the device, where that is larger


# ---- the command and the picture


def test_the_command_says_where_there_is_too_little_to_learn_from(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench_judge, 'FAMILIES', {'p_xray': 1})
    assert main.main(['judge', '--scenes', '1', '--first-seed', '7', '--jobs', '1', '--out',
                      str(tmp_path / 'judge.json')]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert 'too few to learn from' in said and not (tmp_path / 'judge.json').exists()


def test_tasks_are_shares_of_the_families_that_exist():
    tasks = bench_judge.tasks(2, 100, Sources())
    count = {name: sum(t.family == name for t in tasks) for name in bench_judge.FAMILIES}
    assert count['ct'] == 0 and count['wide'] == 24 and count['clutter'] == 4 and count['p_xray'] == 1  # no CT is given
    assert {t.seed for t in tasks if t.family == 'clutter'} == set(range(100, 104))


def test_the_reliability_diagram_shows_silent_failures_in_their_colour(tmp_path):
    pytest.importorskip('matplotlib')
    from fluoro_shape_ros.bench.plot_confidence import draw

    def red_pixels(tip):
        answers = [Answer(k, Outcome.OK, errors=Errors(1e-4, 0.0, 0.0, tip, 0.0, 0.0), confidence=0.5 + k / 40)
                   for k in range(20)]
        draw([*answers, Answer(21, Outcome.LOW_CONFIDENCE)], tmp_path / 'confidence.png')
        image = cv2.imread(str(tmp_path / 'confidence.png')).astype(int)
        assert image.shape[1] == 1200 and image.std() > 5
        near_top = image[:250, 650:]
        return (np.abs(near_top - [0x5f, 0x5a, 0xff]).max(axis=2) < 3).sum()

    assert red_pixels(5e-3) > red_pixels(1e-4) + 50       # all of them, or none
