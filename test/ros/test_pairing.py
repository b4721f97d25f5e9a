"""What stamps decide: hand-derived sequences, and properties over random arrival orders."""

import numpy as np
import pytest

from fluoro_shape_ros.ros.pairing import BUFFER, JUMP_NS, LAST_NS, Pairer

MS = 1_000_000
T0 = 1_000_000 * MS
SLOP = 10 * MS


def feed(pairer, frames):
    """Add frames given as ('a', ms); each frame's item is (plane, ms). The pairs that came out, as (a_ms, b_ms)."""
    pairs = []
    for plane, ms in frames:
        pair = pairer.add(plane, T0 + round(ms * MS), (plane, ms))
        if pair is not None:
            stamp, (plane_a, a), (plane_b, b) = pair
            assert (plane_a, plane_b) == ('a', 'b') and stamp == T0 + round(a * MS)
            pairs.append((a, b))
    return pairs


@pytest.mark.parametrize('frames, pairs', [
    ([('a', 0), ('b', 0)], [(0, 0)]),
    ([('b', 0), ('a', 0)], [(0, 0)]),
    ([('a', 0), ('b', 10)], [(0, 10)]),                             # the slop itself still pairs
    ([('a', 0), ('b', 10.001)], []),
    ([('a', 0), ('b', 30), ('a', 66), ('b', 96)], []),
    ([('a', 0), ('a', 8), ('b', 9)], [(8, 9)]),                     # the nearer one of two
    ([('a', 0), ('a', 10), ('b', 5)], [(10, 5)]),                   # the newer one of two equally near
    ([('a', 0), ('a', 66), ('b', 0), ('b', 66)], [(0, 0), (66, 66)]),
    ([('a', 0), ('a', 66), ('b', 66), ('b', 0)], [(66, 66)]),       # never an older pair after a newer one
    ([('a', 66), ('a', 0), ('b', 0), ('b', 66)], [(0, 0), (66, 66)]),   # out of order, still in time
    ([('a', 0), ('b', 0), ('b', 0), ('a', 0)], [(0, 0)]),           # an image never comes twice
    ([('a', 0), ('b', 66), ('a', 66)], [(66, 66)]),                 # b's first image was lost
])
def test_sequences(frames, pairs):
    assert feed(Pairer(SLOP), frames) == pairs


def test_waits_for_a_nearer_partner_that_the_pace_lets_expect():
    """At 15 ms a frame b=24 lies 9 ms after a=15, but a=30 will be 6 ms away."""
    pairer = Pairer(SLOP)
    assert feed(pairer, [('b', 0), ('a', 0), ('a', 15), ('b', 24)]) == [(0, 0)]
    assert feed(pairer, [('a', 30)]) == [(30, 24)]


def test_takes_the_farther_partner_when_the_nearer_one_was_lost():
    pairer = Pairer(SLOP)
    assert feed(pairer, [('b', 0), ('a', 0), ('a', 15), ('b', 24)]) == [(0, 0)]
    assert feed(pairer, [('a', 45)]) == [(15, 24)]


def test_a_constant_offset_costs_no_latency():
    """At 66 ms a frame nothing can be nearer than 9 ms: every pair comes with its second image."""
    pairer = Pairer(SLOP)
    for k in range(5):
        assert feed(pairer, [('a', 66 * k)]) == []
        assert feed(pairer, [('b', 66 * k + 9)]) == [(66 * k, 66 * k + 9)]


def test_counts():
    pairer = Pairer(SLOP)
    feed(pairer, [('a', 0), ('b', 0), ('b', 0), ('a', 66), ('b', 133), ('b', 100), ('a', 133), ('a', 100)])
    pairer.add('a', 0, None)
    c = pairer.counts
    assert (c.pairs, c.duplicates, c.out_of_order, c.unpaired, c.unstamped, c.jumps) == (2, 1, 2, 3, 1, 0)


def test_zero_stamps_never_pair():
    pairer = Pairer(SLOP)
    assert pairer.add('a', 0, 1) is None and pairer.add('b', 0, 2) is None
    assert pairer.counts.unstamped == 2 and pairer.waiting == 0


@pytest.mark.parametrize('stamp', [-1, LAST_NS + 1])
def test_stamps_that_no_result_could_carry_never_pair(stamp):
    pairer = Pairer(SLOP)
    assert pairer.add('a', stamp, 1) is None and pairer.add('b', stamp, 2) is None
    assert pairer.counts.unstamped == 2 and pairer.gap_ns is None


def test_memory_is_bounded():
    pairer = Pairer(SLOP)
    feed(pairer, [('a', 66 * k) for k in range(1000)])
    assert pairer.waiting == BUFFER and pairer.counts.unpaired == 1000 - BUFFER


@pytest.mark.parametrize('back_ms', [JUMP_NS / MS + 1, 20000])
def test_a_jump_back_starts_anew_at_once(back_ms):
    pairer = Pairer(SLOP)
    feed(pairer, [(p, 30000 + 66 * k) for k in range(3) for p in 'ab'])
    start = 30000 + 66 * 2 - back_ms
    assert feed(pairer, [(p, start + 66 * k) for k in range(3) for p in 'ab']) == [(start + 66 * k,) * 2
                                                                                   for k in range(3)]
    assert pairer.counts.jumps == 1


def test_the_second_pair_after_a_jump_works_even_when_a_plane_lags():
    """Plane b's last frame from before the jump comes after plane a's first one from behind it."""
    pairer = Pairer(SLOP)
    feed(pairer, [('a', 9000), ('b', 9000), ('a', 9066)])
    assert feed(pairer, [('a', 0), ('b', 9066), ('b', 0), ('a', 66), ('b', 66)]) == [(66, 66)]


def test_frames_from_before_a_jump_never_pair_with_later_ones():
    pairer = Pairer(SLOP)
    feed(pairer, [('b', 0), ('a', 9000)])
    assert feed(pairer, [('a', 66), ('a', 133)]) == [] and pairer.counts.jumps == 1
    assert feed(pairer, [('a', 0)]) == []


def test_reset_forgets_what_waits():
    pairer = Pairer(SLOP)
    feed(pairer, [('a', 0)])
    pairer.reset()
    assert feed(pairer, [('b', 0)]) == [] and pairer.counts.unpaired == 1 and pairer.counts.jumps == 0


def test_gap_says_how_far_the_planes_are_apart():
    pairer = Pairer(SLOP)
    feed(pairer, [('a', 30)])
    assert pairer.gap_ns is None
    feed(pairer, [('b', 0)])
    assert pairer.gap_ns == -30 * MS
    feed(pairer, [('b', 66)])
    assert pairer.gap_ns == 36 * MS


def scrambled(rng, step_ms):
    """Two streams with jitter, losses, repeats and late frames, as ('a', ms) in order of arrival."""
    k = np.arange(60)
    frames = []
    for plane in 'ab':
        stamps = k * step_ms + rng.uniform(0, 12, len(k)).round(3) * rng.choice([0, 1])
        keep = stamps[rng.random(len(k)) > 0.1]
        keep = np.concatenate([keep, rng.choice(keep, 5)])
        delay = rng.exponential(step_ms * rng.choice([0.1, 1.0]), len(keep)).clip(0, 3 * step_ms)
        frames += [(arrival, plane, float(ms)) for arrival, ms in zip(keep + delay, keep)]
    return [(plane, ms) for _, plane, ms in sorted(frames)]


@pytest.mark.parametrize('seed', range(40))
def test_properties_over_random_arrivals(seed):
    rng = np.random.default_rng(seed)
    frames = scrambled(rng, step_ms=rng.choice([15.0, 33.0, 66.0]))
    pairer = Pairer(SLOP)
    pairs = feed(pairer, frames)
    assert len(pairs) > 5
    assert all(abs(a - b) <= 10 for a, b in pairs)
    for side in zip(*pairs):
        assert list(side) == sorted(set(side))      # each image once, never an older one after a newer one
    c = pairer.counts
    assert c.pairs == len(pairs) and c.jumps == 0
    assert len(frames) == 2 * c.pairs + c.unpaired + c.duplicates + pairer.waiting


@pytest.mark.parametrize('seed', range(20))
def test_in_order_every_image_gets_its_nearest_partner(seed):
    """Jitter below a quarter step leaves no doubt who belongs together; loss of an image costs just that pair."""
    rng = np.random.default_rng(seed)
    step = 40.0
    stamps = {p: np.arange(50) * step + rng.uniform(0, 10, 50) for p in 'ab'}
    keep = {p: rng.random(50) > 0.15 for p in 'ab'}
    frames = sorted((stamps[p][k], p) for p in 'ab' for k in range(50) if keep[p][k])
    pairs = feed(Pairer(SLOP), [(p, float(ms)) for ms, p in frames])
    assert pairs == [(stamps['a'][k], stamps['b'][k]) for k in range(50) if keep['a'][k] and keep['b'][k]]
