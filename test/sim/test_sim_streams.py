"""Streams: how fast a tip moves, what each fault does to the images, and that a person could find the device."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fluoro_shape_ros.data import Frame
from fluoro_shape_ros.device import water_attenuation
from fluoro_shape_ros.geometry.curve import arc_length, distance_to
from fluoro_shape_ros.sim import carm, ct, faults, motion, placement, streams, variety

VIEWS = carm.biplane()
FIELDS = tuple(placement.Field(v) for v in VIEWS)


@pytest.fixture(scope='module')
def mixed():
    return streams.draw(3, 'mixed')


@pytest.fixture(scope='module')
def plain(mixed):
    """The same without anything that goes wrong."""
    chains = tuple(dataclasses.replace(c, imaging=dataclasses.replace(c.imaging, lag=0.0)) for c in mixed.run.chains)
    return dataclasses.replace(mixed, before=None, wire=None, bolus=None, dark=None,
                               run=dataclasses.replace(mixed.run, chains=chains))


def images(stream, count):
    return [[image.astype(float) for image in m.scene.frame.images] for m in stream.pairs(count)]


# ---- motion


@pytest.mark.parametrize('kind', ['spline', 'cannula'])
@pytest.mark.parametrize('rate, limit', [(15, 0.060), (30, 0.120)])
def test_the_tip_is_no_faster_than_is_said_and_the_base_stays(kind, rate, limit):
    rng = np.random.default_rng(rate)
    shape, _ = placement.place(rng, FIELDS, kind, (0.05, 0.1), False)
    moves = motion.paced(rng, motion.draw(rng, shape), rate)
    dt = 0.005 / moves.rounds
    curves = [moves.backbone(k * dt, 2e-3) for k in range(201)]     # a round
    speed = np.linalg.norm(np.diff([c[-1] for c in curves], axis=0), axis=1) / dt
    assert 0.49 * limit < speed.max() < limit
    assert_allclose([c[0] for c in curves], np.tile(shape.pose.base, (201, 1)), atol=1e-12)
    lengths = [arc_length(c)[-1] for c in curves]
    assert max(lengths) > 0.99 * shape.length and min(lengths) < 0.9 * shape.length     # it withdraws and advances


def test_the_load_swings_the_tip(mixed):
    """Beside the same motion without it, as far to one side as to the other."""
    still = dataclasses.replace(mixed.motion, load=np.zeros(3))
    off = np.array([mixed.motion.backbone(t, 2e-3)[-1] - still.backbone(t, 2e-3)[-1]
                    for t in np.arange(0, 1, 0.05) / mixed.motion.rounds])
    along = off @ (off[np.linalg.norm(off, axis=1).argmax()] / np.linalg.norm(off, axis=1).max())
    assert 0.5e-3 < -along.min() and along.max() < 0.013


# ---- a stream


def test_the_same_seed_is_the_same_stream_but_for_the_faults_of_its_kind(mixed, plain):
    again = streams.draw(3, 'plain')
    assert again.said() == mixed.said() and again.rate == mixed.rate
    assert (again.before is again.wire is again.bolus is again.dark is None
            and not any(c.imaging.lag for c in again.run.chains))
    lit = dataclasses.replace(plain, backgrounds=tuple(b.shifted((0, 0)) for b in plain.backgrounds))
    for image, other in zip(next(again.pairs(1)).scene.frame.images, next(lit.pairs(1)).scene.frame.images):
        assert_array_equal(image, other)


def test_what_is_drawn_can_be_seen_and_stays_in_both_fields(mixed):
    assert variety.visible(mixed.run, True, mixed.backbone(0.0))
    for whole in (mixed.backbone(k / 12 / mixed.motion.rounds) for k in range(12)):
        truth = placement.seen_in_both(whole, mixed.run.fields)
        assert_array_equal(truth[-1], whole[-1])
        assert min(f.room(truth).min() for f in mixed.run.fields) >= 0
        assert arc_length(truth)[-1] > 0.03


def test_stamps_and_noise_go_on(plain):
    first, second = plain.pairs(2)
    assert (first.scene.frame.stamp_ns, second.scene.frame.stamp_ns) == (0, round(1e9 / plain.rate))
    assert first.shown and second.shown and first.scene.frame.images[0].std() > 0
    assert not np.array_equal(first.scene.frame.images[0], second.scene.frame.images[0])


def test_kinds_have_their_faults_and_no_others(mixed):
    faulty = {'lag': lambda s: any(c.imaging.lag for c in s.run.chains), 'stale_mask': lambda s: s.before is not None,
              'wire': lambda s: s.wire is not None,
              'dark': lambda s: s.dark is not None, 'bolus': lambda s: s.bolus is not None}
    assert all(has(mixed) for has in faulty.values())
    assert set(streams.KINDS) == {'plain', 'mixed', *faulty}
    bare = dataclasses.replace(mixed, before=None, wire=None, bolus=None, dark=None)
    for kind in ('wire', 'dark', 'bolus', 'stale_mask'):
        drawn = streams._with_faults(np.random.default_rng(0), dataclasses.replace(bare, kind=kind))
        assert [name for name, has in faulty.items() if has(drawn) and name != 'lag'] == [kind]


# ---- faults


def test_a_dark_plane_is_dark_for_a_second_and_shows_nothing(plain, monkeypatch):
    dark = faults.Dark(1, 0.5)
    assert ([k for k in range(60) if dark.at(k / 15)] == list(range(8, 23))
            and sum(dark.at(k / 30) for k in range(60)) == 30)
    monkeypatch.setattr(faults, 'DARK_S', 1 / plain.rate)       # one pair
    lit, dim = images(plain, 3), list(dataclasses.replace(plain, dark=faults.Dark(1, 1 / plain.rate)).pairs(3))
    assert [m.shown for m in dim] == [True, False, True]
    assert (np.ptp(dim[1].scene.frame.images[1]) == 0
            and dim[1].scene.frame.images[1].max() <= np.percentile(lit[0][1], 1))
    for k, plane in ((0, 0), (0, 1), (1, 0), (2, 0), (2, 1)):
        assert_array_equal(dim[k].scene.frame.images[plane], lit[k][plane])


def test_lag_leaves_a_ghost_that_a_dark_pair_ends(plain, monkeypatch):
    """With nothing but the share of the image before: what is shown is linear in what is detected, and averaging begins
    anew after the dark."""
    monkeypatch.setattr(faults, 'DARK_S', 1 / plain.rate)
    chains = tuple(dataclasses.replace(c, imaging=dataclasses.replace(c.imaging, display='linear', sharpening=0.0,
                                                                      bits=16, black=-0.8, white=0.5))
                   for c in plain.run.chains)
    linear = dataclasses.replace(plain, run=dataclasses.replace(plain.run, chains=chains))
    chains = tuple(dataclasses.replace(c, imaging=dataclasses.replace(c.imaging, lag=0.4)) for c in chains)
    lagging = dataclasses.replace(linear, run=dataclasses.replace(plain.run, chains=chains),
                                  dark=faults.Dark(1, 2 / plain.rate))
    now, shown = images(linear, 4), images(lagging, 4)
    open_ = [(i > 0) & (i < 65535) for i in now[0]], [(i > 0) & (i < 65535) for i in now[1]]
    for plane in (0, 1):
        assert_array_equal(shown[0][plane], now[0][plane])
        inside = open_[0][plane] & open_[1][plane]
        assert_allclose(shown[1][plane][inside], (0.4 * now[0][plane] + 0.6 * now[1][plane])[inside], atol=1.01)
    assert_array_equal(shown[3][1], now[3][1])
    assert not np.array_equal(shown[3][0], now[3][0])


def test_a_mask_shows_the_patient_before_he_moved_and_no_device(mixed, plain):
    assert plain.mask(8) == []
    taken = mixed.mask(2)
    assert (len(taken) == 2 and all(isinstance(f, Frame) for f in taken)
            and not np.array_equal(taken[0].images[0], taken[1].images[0]))
    for before, now in zip(mixed.before, mixed.backgrounds):
        assert before.moved_px == (0.0, 0.0) and 2 <= np.hypot(*now.moved_px) <= 5
        assert_array_equal(before.picture, now.picture)


def test_a_wire_comes_from_aside_and_meets_the_device(mixed):
    wire, meets = mixed.wire, mixed.wire.meets_s
    assert distance_to(mixed.motion.backbone(meets), wire.at(meets)).min() < 0.3e-3
    moved = wire.at(meets + 1) - wire.at(meets)
    assert_allclose(moved, np.tile(moved[0], (len(moved), 1)), atol=1e-12)
    assert 0.02 <= np.linalg.norm(moved[0]) <= 0.04
    assert_allclose(wire.at(meets + 1000), wire.at(meets + 4))      # it never reaches a source
    view, kev = mixed.run.fields[0].view, mixed.run.chains[0].imaging.energy_kev
    assert wire.depth(meets, view, kev).max() > 0.05


def test_a_bolus_darkens_a_part_of_the_field_for_two_seconds(plain):
    bolus = faults.draw_bolus(np.random.default_rng(0), tuple(f.view for f in plain.run.fields))
    begins = bolus.begins_s
    assert 0.3 <= begins <= 0.8 and bolus.share(begins) == 0 == bolus.share(begins + 2)
    assert_allclose([bolus.share(begins + t) for t in (0.3, 0.7, 1.2)], 1.0)
    assert all(bolus.share(begins + t) > 0 for t in (0.1, 1, 1.9)) and bolus.share(0) == bolus.share(9) == 0
    for depth in bolus.depths:
        assert 0.29 < depth.max() < 0.81 and (depth > 0.5 * depth.max()).mean() < 0.3
    now, later = (images(plain, 1)[0],
                  images(dataclasses.replace(plain, bolus=dataclasses.replace(bolus, begins_s=-0.5)), 1)[0])
    for i, (before, after) in enumerate(zip(now, later)):
        dense = (bolus.depths[i] > 0.6 * bolus.depths[i].max()) & (before > 0)
        if plain.apertures[i] is not None:
            dense &= plain.apertures[i] > 0.5
        assert not dense.any() or after[dense].mean() < before[dense].mean()


def test_a_stream_before_a_ct():
    """A block of water that fills the field, from an edge of which the device keeps away: it lets so much through as
    the water that it is."""
    volume = ct.Volume(np.zeros((60, 60, 60), np.int16), np.full(3, 3e-3))
    drawn = streams.draw(0, 'plain', volume)
    for b, chain in zip(drawn.backgrounds, drawn.run.chains):
        passed = b.at(0.0)[streams.SIZE_PX // 2, streams.SIZE_PX // 2]
        # m: 0.18 m across, and slanting
        assert 0.12 < -np.log(passed) / water_attenuation(chain.imaging.energy_kev) < 0.32


def test_another_kind_is_refused_by_name():
    with pytest.raises(ValueError, match='calm.*plain'):
        streams.draw(0, 'calm')
