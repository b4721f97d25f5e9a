"""A background that breathes: by how much it moves, what stays where it is, and that a CT stands where its projection
does."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fluoro_shape_ros.data import View
from fluoro_shape_ros.device import REFERENCE_KEV
from fluoro_shape_ros.sim import breathing, carm, ct

SIZE, M = 96, breathing.MARGIN_PX
VIEWS = carm.biplane(arm=carm.CArm(pixel_size_iso=1.6e-3, width=SIZE, height=SIZE))
STEP = 8                # px between the places that tell a displacement


@pytest.fixture
def by_hand():
    """Noise that breathes by 12 px everywhere, and beats by 3 px to the right; breathed out at 0 s."""
    picture, ones = np.random.default_rng(0).random((SIZE + 2 * M,) * 2, np.float32), np.ones((SIZE, SIZE), np.float32)
    return breathing.Breathing(picture, np.ones_like(picture), ones, 12.0, 0.0, ones, (3.0, 0.0), 0.0)


def test_half_a_breath_moves_it_down_by_all_of_its_way(by_hand):
    """Two seconds at 0.25 Hz; the heart, without amplitude, stands still."""
    still = dataclasses.replace(by_hand, beat_px=(0.0, 0.0))
    assert_allclose(still.at(0.0), by_hand.picture[M:-M, M:-M], atol=1e-6)
    assert_allclose(still.at(2.0)[12:], still.at(0.0)[:-12], atol=1e-6)
    assert_allclose(still.at(4.0), still.at(0.0), atol=1e-5)


def test_a_quarter_of_a_beat_moves_it_aside(by_hand):
    still = dataclasses.replace(by_hand, breath_px=0.0)
    assert_allclose(still.at(0.25 / 1.2)[:, 3:], still.at(0.0)[:, :-3], atol=1e-5)
    assert_allclose(still.at(0.75 / 1.2)[:, :-3], still.at(0.0)[:, 3:], atol=1e-5)


def test_only_what_moves_is_moved_by_a_breath_and_all_by_the_patient(by_hand):
    alone = dataclasses.replace(by_hand, still=by_hand.picture, picture=np.ones_like(by_hand.picture),
                                beat_px=(0.0, 0.0))
    assert_array_equal(alone.at(2.0), alone.at(0.0))
    for b in (alone, dataclasses.replace(by_hand, beat_px=(0.0, 0.0))):
        assert_allclose(b.shifted((2, -3)).at(0.0)[:-3, 2:], b.at(0.0)[3:, :-2], atol=1e-6)


@pytest.mark.parametrize('seed', range(4))
def test_a_drawn_patient_moves_as_far_as_is_said(seed):
    patient = breathing.patient(np.random.default_rng(seed), VIEWS)
    both = [patient(i, REFERENCE_KEV) for i in (0, 1)]
    assert both[0].breath_phase == both[1].breath_phase and both[0].beat_phase == both[1].beat_phase
    for b in both:
        assert 0 < b.at(0.3).min() and b.at(0.3).max() <= 1.1   # where an edge is sharp, cubic interpolation overshoots
        calm = dataclasses.replace(b, beat_px=(0.0, 0.0))
        down = np.stack([calm.displacement(t)[1][::STEP, ::STEP] for t in np.arange(0, 4, 0.1)])
        way = np.ptp(down, axis=0)
        assert 0.98 * 10 <= way.max() <= 15 and way.min() >= 0.3 * 0.98 * 10
        assert np.gradient(down, STEP, axis=1).max() < 1        # it is not folded
        beaten = dataclasses.replace(b, breath_px=0.0)
        u, v = np.stack([[d[::STEP, ::STEP] for d in beaten.displacement(t)] for t in np.arange(0, 1, 0.02)], axis=1)
        assert 1.4 < np.hypot(u, v).max() <= 3
    assert_array_equal(patient(0, REFERENCE_KEV).picture, both[0].picture)


def test_a_harder_beam_passes_more_of_the_same_patient():
    patient = breathing.patient(np.random.default_rng(1), VIEWS)
    soft, hard = (patient(0, kev) for kev in (50.0, 90.0))
    assert (soft.at(0.5) < hard.at(0.5)).mean() > 0.99 and soft.breath_px == hard.breath_px


def test_a_ct_stands_where_its_projection_does():
    """A ball of water with one of bone in it, of which the margin shows no more than the field's surroundings."""
    z, y, x = np.mgrid[0:60, 0:60, 0:60] * 3e-3 - 0.0885
    hu = np.where(x**2 + y**2 + z**2 < 0.08**2, 0, -1000).astype(np.int16)
    hu[(x - 0.03)**2 + y**2 + (z - 0.02)**2 < 0.015**2] = 1200
    volume, seed = ct.Volume(hu, np.full(3, 3e-3)), 5
    b = breathing.patient(np.random.default_rng(seed), VIEWS, volume)(0, REFERENCE_KEV)
    rng = np.random.default_rng(seed)
    rng.uniform(0, 1, 2), rng.integers(2**31)       # what comes before the patient lies down
    where = ct.draw_placement(rng, volume)
    at_rest = dataclasses.replace(b, breath_px=0.0, beat_px=(0.0, 0.0)).at(0.0)
    view = View('a', VIEWS[0].P, SIZE, SIZE)
    assert np.ptp(at_rest) > 0.3
    assert_allclose(at_rest, np.exp(-ct.optical_depth(ct.path_lengths(volume, view, where), REFERENCE_KEV)), atol=0.01)
