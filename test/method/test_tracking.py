"""Starting from the pair before: the same answers as a search of the whole images, also where the device moves fast,
jumps or is gone for a while."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Prior, Searched
from fluoro_shape_ros.method import judge
from fluoro_shape_ros.method.pipeline import _stands, reconstruct
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.shapes import posed

VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
STEP = 0.030 / 15       # m from pair to pair at 30 mm/s and 15 pairs/s
SAME, SAME_TIP = 0.02e-3, 0.1e-3    # m
RIGHT = 0.3e-3          # m, of the truth


@cache
def run(seed=5):
    return xray_run(seed, views=VIEWS, lengths=(0.06, 0.07))


CONFIG = Config.from_values(base_position=run().backbone()[0].tolist())


def pictures(shapes):
    """Scenes of the run's device in these shapes, each with noise of its own, 15 a second."""
    scenes = [replace(run(), shape=shape).scene(index=k) for k, shape in enumerate(shapes)]
    return [replace(scene, frame=replace(scene.frame, stamp_ns=10**9 + k * 10**9 // 15))
            for k, scene in enumerate(scenes)]


def moved(x, y=0.0, z=0.0):
    """The device as a whole elsewhere, m."""
    shape = run().shape
    return replace(shape, pose=replace(shape.pose, base=shape.pose.base + [x, y, z]))


def search(scene):
    return reconstruct(scene.frame, CONFIG)


def follow(scenes, previous=None):
    """The answers, each beginning from the last two shapes."""
    answers, known = [], [(previous, None)]
    for scene in scenes:
        last, before = known[-1], known[-2] if len(known) > 2 else (None, None)
        answers.append(reconstruct(scene.frame, CONFIG, Prior(*last, *before)))
        if answers[-1].shape is not None:
            known.append((answers[-1].shape, scene.frame.stamp_ns))
    return answers


def same(a, b):
    """Whether two shapes are within SAME of each other, taken over their lengths, and their tips within what noise does
    to a tip."""
    fine = [np.array([np.interp(np.linspace(0, x.length, 4000), x.s, c) for c in x.points.T]).T for x in (a, b)]
    between = max(cKDTree(one).query(other)[0].mean() for one, other in (fine, fine[::-1]))
    return between < SAME and np.linalg.norm(a.tip - b.tip) < SAME_TIP


def is_right(answer, scene):
    return answer.shape is not None and cKDTree(scene.truth).query(answer.shape.points)[0].mean() < RIGHT \
        and np.linalg.norm(answer.shape.tip - scene.truth[-1]) < 2 * RIGHT


MOTIONS = {
    'sliding in': [posed(run().shape, 1 - k / 5, 0.0) for k in range(5)],       # by 2.4 to 2.8 mm a pair
    'bending': [posed(run().shape, 0.0, k / 5) for k in range(5)],
    'fast across': [moved(k * STEP * 0.6, -k * STEP * 0.6, k * STEP * 0.53) for k in range(5)],
    'back and forth': [moved(STEP * (k % 2)) for k in range(5)],  # whatever was expected from the pairs before is wrong
}


@pytest.mark.parametrize('motion', MOTIONS)
def test_tracking_answers_as_a_search_does_and_needs_none(motion):
    scenes = pictures(MOTIONS[motion])
    for scene, answer in zip(scenes[1:], follow(scenes)[1:]):
        searched = search(scene)
        assert is_right(answer, scene) and is_right(searched, scene), (answer.detail, searched.detail)
        assert same(answer.shape, searched.shape)
        assert 'track' in answer.stage_seconds and 'search' not in answer.stage_seconds


def test_a_device_faster_than_any_search_around_it_is_expected_where_it_will_be():
    *_, now = scenes = pictures([moved(0.0055 * k) for k in range(3)])
    first, second = (search(scene).shape for scene in scenes[:2])
    known = dict(previous=second, previous_stamp_ns=scenes[1].frame.stamp_ns)
    assert 'search' in reconstruct(now.frame, CONFIG, Prior(**known)).stage_seconds
    answer = reconstruct(now.frame, CONFIG, Prior(**known, before=first, before_stamp_ns=scenes[0].frame.stamp_ns))
    assert 'search' not in answer.stage_seconds and is_right(answer, now) and same(answer.shape, search(now).shape)


def test_a_tip_that_swings_while_most_of_the_device_stays_is_followed():
    entering = xray_run(7, views=VIEWS, lengths=(0.10, 0.12), entering=True)
    # the tip by 3.7 mm a pair
    scenes = [replace(entering, shape=posed(entering.shape, 0.0, 0.5 * k)).scene(index=k) for k in range(4)]
    for scene, answer in zip(scenes[1:], follow(scenes)[1:]):
        assert (answer.shape is not None
                and np.linalg.norm(answer.shape.tip - scene.truth[-1]) < 2 * RIGHT), answer.detail
        assert 'search' not in answer.stage_seconds


@pytest.mark.parametrize('there', [moved(0.02, 0.0, -0.02), posed(run().shape, 1.0, 1.0)],
                         ids=['elsewhere', 'another shape'])
def test_a_device_that_jumps_is_found_in_the_same_pair(there):
    before, after = pictures([run().shape, there])
    answer = follow([before, after])[1]
    assert is_right(answer, after) and same(answer.shape, search(after).shape)


def test_an_end_that_slips_far_is_compared_with_what_all_of_the_images_show():
    before, now = pictures([run().shape, moved(0.005)])
    first = search(before).shape
    answer = reconstruct(now.frame, CONFIG, Prior(previous=first))
    assert {'track', 'search'} <= set(answer.stage_seconds) and same(answer.shape, search(now).shape)


@pytest.mark.parametrize('missed', [1, 3, 10])
def test_missed_pairs_do_no_harm(missed):
    before, after = pictures([run().shape, moved((missed + 1) * STEP)])
    answer = follow([before, after])[1]
    assert is_right(answer, after) and same(answer.shape, search(after).shape)


def test_where_the_device_is_no_more_everything_is_searched():
    before, after = pictures([run().shape, moved(STEP)])
    empty, previous = run().without_device(), search(before).shape
    gone = reconstruct(empty, CONFIG, Prior(previous=previous))
    assert 'search' in gone.stage_seconds and gone.outcome is reconstruct(empty, CONFIG).outcome
    assert is_right(follow([after], previous)[0], after)


def test_without_tracking_the_previous_shape_changes_nothing():
    scene, = pictures([run().shape])
    config = CONFIG.replace(tracking=False)
    plain, given = reconstruct(scene.frame, config), reconstruct(scene.frame, config,
                                                                 Prior(previous=search(scene).shape))
    assert 'track' not in given.stage_seconds and np.array_equal(plain.shape.points, given.shape.points)


def test_what_stands_as_it_stood_when_everything_was_searched_needs_no_other_search(monkeypatch):
    monkeypatch.setattr(judge, 'STILL_THERE', 1.1)      # as if nothing near where it was were beyond doubt by itself
    first, second, third = pictures([moved(k * 0.1 * STEP) for k in range(3)])
    found = search(first)
    known = Prior(found.shape, first.frame.stamp_ns, searched=found.searched)
    answer = reconstruct(second.frame, CONFIG, known)
    assert is_right(answer, second) and 'search' not in answer.stage_seconds and answer.searched is found.searched
    likelier = replace(found.searched, log_odds=found.searched.log_odds + 2.0)
    for prior in (replace(known, searched=None), replace(known, searched=likelier)):
        again = reconstruct(second.frame, CONFIG, prior)
        assert 'search' in again.stage_seconds and again.searched.log_odds != likelier.log_odds
    # what is refused as it was, another search would refuse, too
    surer = 1 - 0.5 * (1 - answer.confidence)
    refused = reconstruct(second.frame, CONFIG.replace(min_confidence=surer), known)
    assert refused.outcome is Outcome.LOW_CONFIDENCE and refused.searched is found.searched
    assert 'search' not in refused.stage_seconds


@pytest.mark.parametrize('nats, rivals, stands', [
    (0.0, 0.0, True), (-0.9, 0.0, True), (-1.1, 0.0, False),    # as it was, a little and much less likely
    (0.0, 1.0, True), (0.0, 100.0, False)])                     # beside others that nobody would publish it
def test_how_a_curve_stands_beside_what_was_found_before(nats, rivals, stands):
    model, odds = judge.load(), np.log(0.9 / 0.1)
    p = _stands(odds + nats, model, 0.7, Searched(odds, rivals))
    assert (p is not None) == stands
    assert not stands or p == pytest.approx(1 / (1 + (1 + rivals) * np.exp(-odds - nats)))
    assert _stands(odds, model, 0.7, None) is None
