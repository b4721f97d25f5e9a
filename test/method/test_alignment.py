"""Curves in space, projected without error: which image lines belong together, and which of their points."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.geometry.cameras import fundamental, project
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.method.propose.alignment import align
from fluoro_shape_ros.sim.carm import CArm, biplane

PX = 0.3e-3                                     # m at the isocentre
VIEWS = biplane(arm=CArm(pixel_size_iso=PX, width=512, height=512))
F = fundamental(VIEWS[0].P, VIEWS[1].P)         # both sources lie in the plane z = 0: epipolar lines are nearly rows
T = np.linspace(0, 1, 600)
CURVES = {
    'monotone': np.c_[0.01 * np.sin(3 * T), 0.015 * T**2, 0.08 * T - 0.04],
    'slanted': np.c_[0.05 * T - 0.025, 0.03 * T - 0.015, 0.03 * T],
    'tangent': np.c_[0.06 * T - 0.03, 0.01 * T, -0.08 * (T - 0.4)**2],      # turns back in z: every line is met twice
    'screw': np.c_[0.02 * np.cos(6.5 * T), 0.02 * np.sin(6.5 * T) + 0.02 * T, 0.06 * T - 0.03],
    # crosses itself in plane A
    'loop': np.c_[0.015 * np.sin(8.5 * T - 1) + 0.01 * T, 0.03 * T, 0.015 * np.cos(8.5 * T - 1)],
}


def seen(X):
    """The (N, 2) image lines of (M, 3) points in both planes, a px a point."""
    lines = (project(v.P, X) for v in VIEWS)
    return [at_arc_length(px, np.arange(0, arc_length(px)[-1], 1.0)) for px in lines]


def match(a, b, **options):
    return list(align(a, b, [np.ones(len(a)), np.ones(len(b))], F, **options))


def apart(found, X):
    """(K,) m between the two points of `X` that each matched pair stands for; a flipped line's arc length counts from
    its last point."""
    ta, tb = (np.interp(s, arc_length(project(v.P, X)), T) for s, v in zip((found.along_a, found.along_b), VIEWS))
    return np.linalg.norm([np.interp(ta, T, c) - np.interp(tb, T, c) for c in X.T], axis=0)


@pytest.mark.parametrize('flipped', [False, True])
@pytest.mark.parametrize('name', CURVES)
def test_a_curve_is_matched_with_itself(name, flipped):
    X = CURVES[name]
    a, b = seen(X)
    best = match([a], [b[::-1] if flipped else b])[0]
    assert (best.a, best.b, best.flipped) == (0, 0, flipped)
    assert (np.diff(best.along_a) >= 0).all() and (np.diff(best.along_b) >= 0).all()
    for along, line in ((best.along_a, a), (best.along_b, b)):
        assert along[0] < 15 and arc_length(line)[-1] - along[-1] < 15          # the whole of it
    assert np.median(apart(best, X)) < 7 * PX                                   # about a sample of either curve


def test_the_curves_are_as_hard_as_they_say():
    rises = np.diff(seen(CURVES['tangent'])[0][:, 1]) > 0
    assert 0.2 < rises.mean() < 0.8
    a = seen(CURVES['loop'])[0]
    gap = np.linalg.norm(a[:, None] - a, axis=2)
    gap[np.abs(np.subtract.outer(np.arange(len(a)), np.arange(len(a)))) < 40] = np.inf
    assert gap.min() < 1


@pytest.mark.parametrize('plane', [0, 1])
def test_what_only_one_plane_sees_past_an_end_stays_out(plane):
    X = CURVES['monotone']
    lines = seen(X)
    true = [arc_length(line)[-1] for line in lines]
    step = lines[plane][-1] - lines[plane][-2]
    lines[plane] = np.concatenate([lines[plane], lines[plane][-1] + np.arange(1, 81)[:, None] * step])
    best = match(*[[line] for line in lines])[0]
    assert not best.flipped
    assert_allclose([best.along_a[-1], best.along_b[-1]], true, atol=15)        # three samples


def test_what_one_plane_does_not_see_in_the_middle_is_skipped():
    X = CURVES['monotone']
    a, b = seen(X)
    n = len(b)
    bent = np.concatenate([b[:n // 2 - 20], b[n // 2 + 20:]])                   # 40 px missing: the line jumps there
    best = match([a], [bent])[0]
    assert best.along_a[0] < 15 and arc_length(a)[-1] - best.along_a[-1] < 15 and not best.flipped


def test_the_partner_is_found_among_others():
    a, b = zip(*(seen(X) for X in CURVES.values()))
    for k in range(len(CURVES)):
        assert match([a[k]], list(b))[0].b == k
        assert match(list(a), [b[k]])[0].a == k
    pairs = match(list(a), list(b), best=3)
    assert len(pairs) == 3 and pairs[0].a == pairs[0].b
    assert pairs[0].score >= pairs[1].score >= pairs[2].score > 0


def test_weights_tip_the_balance_between_equals():
    a, b = seen(CURVES['monotone'])
    for weights, wins in (([1.0, 0.5], 0), ([0.5, 1.0], 1)):
        assert next(align([a], [b, b], [np.ones(1), np.array(weights)], F)).b == wins


def test_curves_that_share_no_epipolar_line_do_not_match():
    a, b = seen(CURVES['slanted'])
    assert not match([a], [b + [0, 150.0]])
    assert not match([a], [])
    assert not match([], [b])


def test_of_many_curves_the_best_come_first_however_many_are_asked_for():
    rng = np.random.default_rng(3)
    pairs = [seen(X + rng.normal(0, 0.01, 3)) for X in CURVES.values() for _ in range(3)]
    a, b = zip(*pairs)
    weights = [rng.uniform(0.1, 1.0, len(pairs)) for _ in 'ab']
    found = list(align(a, b, weights, F, best=40))
    scores = [x.score for x in found]
    assert len(found) > 10 and scores == sorted(scores, reverse=True)
    assert [(x.a, x.b, x.flipped) for x in align(a, b, weights, F, best=3)] == [(x.a, x.b, x.flipped)
                                                                                 for x in found[:3]]
    # and one by one, so that nothing is left out because it was looked at late
    alone = {(i, j): x.score for i in range(len(a)) for j in range(len(b))
             for x in align([a[i]], [b[j]], [weights[0][i:i + 1], weights[1][j:j + 1]], F, best=1)}
    assert scores[0] == pytest.approx(max(alone.values()), rel=1e-5)
    assert sum(s >= scores[-1] * 1.0001 for s in alone.values()) <= len(found)
