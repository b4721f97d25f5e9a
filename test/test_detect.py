"""The device among other lines: found, chosen by both planes, tracked, and missed by name."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from fluoro_shape_ros.imaging.lines import Candidate
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Prior
from fluoro_shape_ros.method.detect import candidates_of, detect, explained, track
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.geometry.cameras import project
from fluoro_shape_ros.method.plausibility import evidence
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.method.prediction import look
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.imaging.strips import Sheet
from fluoro_shape_ros.bench.families import families

VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
RADIUS, HALF_WIDTH = 0.0006, 2.0        # m, and px of it
MIN_LENGTH = 60.0


def prepared(frame):
    """What the pipeline hands on: square roots of the counts, with fields and views."""
    return Sheet.of([np.sqrt(i.astype(np.float32)) for i in frame.images], [field_of_view(i) for i in frame.images], frame.views)


def mean_off(f, truth):
    return cKDTree(truth).query(f.spline(np.linspace(f.start, f.stop, 300)))[0].mean()


@pytest.fixture(scope='module')
def run():
    return xray_run(1, views=VIEWS, lengths=(0.06, 0.08))


@pytest.fixture(scope='module')
def scene(run):
    return run.scene()


@pytest.fixture(scope='module')
def found(scene):
    return detect(prepared(scene.frame), RADIUS, MIN_LENGTH)


def test_the_device_is_found_in_front_of_anatomy(scene, found):
    assert found.outcome is Outcome.OK and mean_off(found.fit, scene.truth) < 0.08e-3
    ends = found.fit.spline(np.array([found.fit.start, found.fit.stop]))
    assert cKDTree(ends).query(scene.truth[[0, -1]])[0].max() < 0.4e-3      # which is which is not settled here


def test_what_was_seen_lies_on_the_device(scene, found):
    for view, seen in zip(VIEWS, found.seen_px):
        assert np.median(cKDTree(project(view.P, scene.truth)).query(seen)[0]) < 1.0
        assert len(seen) > 100


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_the_device_is_among_the_best_candidates_of_either_image(seed):
    scene = xray_run(seed, views=VIEWS, lengths=(0.06, 0.08)).scene()
    sheet = prepared(scene.frame)
    for image, field, view in zip(sheet.planes, sheet.fields, sheet.views):
        candidates = candidates_of(image, field, HALF_WIDTH, MIN_LENGTH)
        assert all(0 < c.score <= 1 for c in candidates)
        true = cKDTree(project(view.P, scene.truth))
        share = [np.mean(true.query(c.points_px)[0] < 2) for c in candidates]
        assert max(share) > 0.7


def test_a_line_of_the_devices_width_is_liked_better_than_a_wider_one():
    v, u = np.mgrid[0:300, 0:300].astype(float)
    noise = np.random.default_rng(0).normal(0, 0.5, u.shape)
    image = 100 - 20 * np.sqrt(np.maximum(1 - ((v - 90) / 2) ** 2, 0)) - 30 * np.sqrt(np.maximum(1 - ((v - 200) / 7) ** 2, 0))
    candidates = candidates_of((image + noise).astype(np.float32), np.full(u.shape, 255, np.uint8), HALF_WIDTH, MIN_LENGTH)
    assert abs(np.median(candidates[0].points_px[:, 1]) - 90) < 1
    assert all(c.score < 0.5 * candidates[0].score for c in candidates[1:])


def test_without_a_device_the_plane_is_named(run, scene):
    plain = xray_run(1, views=VIEWS, lengths=(0.06, 0.08), anatomy=False)
    there, gone = plain.scene().frame, plain.without_device()
    for images, outcome in (((gone.images[0], there.images[1]), Outcome.NO_DEVICE_A), ((there.images[0], gone.images[1]), Outcome.NO_DEVICE_B),
                            (gone.images, Outcome.NO_DEVICE_A)):
        result = detect(prepared(replace(there, images=images)), RADIUS, MIN_LENGTH)
        assert result.fit is None and result.outcome is outcome and result.detail
        assert (result.seen_px[0] is None) == (outcome is Outcome.NO_DEVICE_A)


def test_lines_that_share_no_epipolar_lines_do_not_correspond():
    plain = xray_run(1, views=VIEWS, lengths=(0.06, 0.08), anatomy=False).scene().frame
    rolled = np.roll(plain.images[1], 230, axis=0)      # the device stands nearly half the image lower there
    result = detect(prepared(replace(plain, images=(plain.images[0], rolled))), RADIUS, MIN_LENGTH)
    assert result.outcome is not Outcome.OK and result.fit is None


def test_a_line_that_is_half_another_in_one_plane_is_looked_for_anew(scene, monkeypatch):
    def mixed(image, field, *rest):
        """In plane a the device; in plane b its first half, going on straight as a lead might."""
        k = next(k for k, i in enumerate(sheet.planes) if i is image)
        line = project(VIEWS[k].P, scene.truth)
        if k == 1:
            half = len(line) // 2
            step = line[half] - line[half - 1]
            line = np.concatenate([line[:half], line[half] + np.arange(len(line) - half)[:, None] * (step + np.linalg.norm(step) * np.array([0.5, 0]))])
        line = at_arc_length(line, np.arange(0, arc_length(line)[-1]))
        return [Candidate(line, np.ones(len(line)), 0.9)]

    sheet = prepared(scene.frame)
    monkeypatch.setattr('fluoro_shape_ros.method.detect.candidates_of', mixed)
    result = detect(sheet, RADIUS, MIN_LENGTH)
    assert result.outcome is Outcome.OK and mean_off(result.fit, scene.truth) < 0.08e-3
    ends = result.fit.spline(np.array([result.fit.start, result.fit.stop]))
    assert cKDTree(ends).query(scene.truth[[0, -1]])[0].max() < 0.4e-3


def test_tracking_goes_on_from_where_the_device_was(scene, found):
    tracked = track(prepared(scene.frame), RADIUS, 60.0, scene.truth + [0.3e-3, -0.3e-3, 0.3e-3])
    assert tracked.outcome is Outcome.OK and mean_off(tracked.fit, scene.truth) < 0.08e-3
    for seen, before in zip(tracked.seen_px, found.seen_px):
        assert np.median(cKDTree(before).query(seen)[0]) < 1.5


def test_tracking_gives_up_where_the_device_is_not(run, scene):
    assert track(prepared(run.without_device()), RADIUS, 60.0, scene.truth) is None
    assert track(prepared(scene.frame), RADIUS, 60.0, scene.truth + [0.02, 0.0, 0.0]) is None


@pytest.mark.parametrize('other, sure', [
    (dict(), True),
    (dict(aside=np.array([[0.0, 0.0], [0.0, 0.7]])), False),      # a line beside an end
    (dict(weakest=np.array([0.89, 1.0]), end_sigma=np.full(2, 0.1e-3)), False),     # its ends are clear, but part of it is something else
    (dict(end_sigma=np.array([0.1e-3, 0.5e-3])), None),                                         # blunt
    (dict(alone=np.array([-1, 0])), None),
    (dict(likeness=np.array([0.5, 0.5])), None),
])
def test_a_tracked_fit_in_doubt_wants_the_whole_images_searched(scene, found, monkeypatch, other, sure):
    monkeypatch.setattr('fluoro_shape_ros.method.detect.fit', lambda *_: replace(found.fit, **dict(aside=np.zeros((2, 2))) | other))
    tracked = track(prepared(scene.frame), RADIUS, 60.0, scene.truth)
    assert (None if tracked is None else tracked.sure) is sure


def test_a_lead_counts_by_what_speaks_for_it_but_less_than_what_lines_led_to(scene, found, monkeypatch):
    better = replace(found.fit, likeness=np.ones(2))
    sheet = prepared(scene.frame)
    assert detect(sheet, RADIUS, MIN_LENGTH, leads=[better]).fit is not better
    monkeypatch.setattr('fluoro_shape_ros.method.detect.UNASKED', 1.0)
    result = detect(sheet, RADIUS, MIN_LENGTH, leads=[replace(better, likeness=np.full(2, 0.9)), better])
    assert result.fit is better
    for seen, before in zip(result.seen_px, found.seen_px):
        assert np.median(cKDTree(before).query(seen)[0]) < 1.5


def test_where_no_lines_belong_together_a_prediction_leads_to_the_device(scene, monkeypatch):
    monkeypatch.setattr('fluoro_shape_ros.method.detect._pairs', lambda *_: iter(()))
    monkeypatch.setattr('fluoro_shape_ros.method.detect.sweep', lambda *_: None)
    sheet, bent = prepared(scene.frame), scene.truth + [[0, 0, 0.004]] * np.linspace(0, 1, len(scene.truth))[:, None] ** 2
    assert detect(sheet, RADIUS, MIN_LENGTH).outcome is Outcome.NO_CORRESPONDENCE
    result = detect(sheet, RADIUS, MIN_LENGTH, look(Prior(predicted=bent), VIEWS, 0.01)[0])
    assert result.outcome is Outcome.OK and not result.doubt and mean_off(result.fit, scene.truth) < 0.08e-3
    shifted = detect(sheet, RADIUS, MIN_LENGTH, look(Prior(predicted=bent + [0.03, 0.03, 0]), VIEWS, 0.01)[0])
    assert shifted.outcome is Outcome.NO_CORRESPONDENCE


def test_explained_is_the_share_of_the_line_near_the_curve(scene, found):
    line = project(VIEWS[0].P, scene.truth)[::5]
    seen = np.ones(len(line), bool)
    assert explained(found.fit, VIEWS[0], line, seen) > 0.98
    assert explained(found.fit, VIEWS[0], line + [0, 20.0], seen) < 0.3
    aside = line[-1] + np.c_[np.arange(1, len(line) + 1), np.zeros(len(line))] * 3.0        # as many points again, going off
    both = np.concatenate([line, aside])
    assert_allclose(explained(found.fit, VIEWS[0], both, np.ones(len(both), bool)), 0.5, atol=0.03)
    gap = np.ones(len(both), bool)
    gap[len(line):len(line) + 2] = False                # behind a gap it may be another line
    assert explained(found.fit, VIEWS[0], both, gap) > 0.95


def test_evidence_counts_what_makes_a_device(found):
    f, full = found.fit, evidence(found.fit)
    assert full > 0
    worse = [replace(f, likeness=f.likeness - 0.1), replace(f, beyond=np.full((2, 2), 0.9)), replace(f, presence=f.presence * [1.0, 0.0]),
             replace(f, contrast=f.contrast * [1, 2.5], across=f.across * [1, 2.5])]
    assert all(evidence(w) < 0.6 * full for w in worse)
    assert evidence(replace(f, contrast=f.contrast * [1, -1])) == 0
    half = replace(f, stop=(f.start + f.stop) / 2)
    assert_allclose(evidence(half), full * np.sqrt(0.5), rtol=0.05)


@pytest.mark.parametrize('seed, told', [(10018, True), (10027, False)])
def test_lines_along_epipolar_lines_fit_both_ways_round_and_only_clear_ends_tell(seed, told):
    case = families()['tangent'].make(seed)
    scene = case.scene
    answer = reconstruct(scene.frame, Config.from_values(robot_radius=scene.radius))
    if told:
        assert answer.outcome is Outcome.OK and cKDTree(scene.truth).query(answer.shape.points)[0].max() < 0.5e-3
    else:
        assert answer.outcome is Outcome.NO_CORRESPONDENCE and 'two curves' in answer.detail
