"""Pairing over any order of arrival: never a wrong pair, never an image twice, never an older pair after a newer one,
memory bounded."""

import pytest

pytest.importorskip('hypothesis')

from generated import examples
from hypothesis import given
from hypothesis import strategies as st

from fluoro_shape_ros.ros.pairing import BUFFER, JUMP_NS, LAST_NS, PLANES, Pairer
from fluoro_shape_ros.ros.waiting import BUFFER as ROOM
from fluoro_shape_ros.ros.waiting import PATIENCE_S, CameraBook, Pair, WaitingRoom

MS = 1_000_000
T0 = 10**12
ANY_STAMP = st.one_of(st.integers(-5, 5), st.integers(0, 2**33 * 10**9),
                      st.integers(0, 2000).map(lambda ms: T0 + ms * MS))


@st.composite
def streams(draw):
    """Two streams with jitter, loss, repeats, delays and, perhaps, jumps: (plane, stamp_ns) in order of arrival."""
    step = draw(st.sampled_from([15, 33, 66]))
    jitter, delay = draw(st.sampled_from([0, 4, 12])), draw(st.sampled_from([0, 5, 200]))
    arrivals, start = [], T0
    for lap in range(draw(st.integers(1, 3))):
        for k in range(draw(st.integers(1, 25))):
            for plane in PLANES:
                stamp = start + (k * step + draw(st.integers(0, jitter))) * MS
                copies = draw(st.sampled_from([0, 1, 1, 1, 1, 1, 1, 2]))
                arrivals += [(lap, k * step + draw(st.integers(0, delay)), plane, stamp) for _ in range(copies)]
        start += draw(st.sampled_from([-30, -1, 40])) * 10**9
    return [(plane, stamp) for _, _, plane, stamp in sorted(arrivals)]


def check_pairs(frames, slop_ns):
    """Feed the frames, each an item of its own; every promise of the pairer."""
    pairer, used, last, jumps, pairs = Pairer(slop_ns), set(), (0, 0), 0, 0
    for number, (plane, stamp) in enumerate(frames):
        pair = pairer.add(plane, stamp, number)
        if pairer.counts.jumps > jumps:
            jumps, last, oldest = pairer.counts.jumps, (0, 0), number
            assert any(p == plane and s > stamp + JUMP_NS for p, s in frames[:number])
            used.add(('jump', oldest))
        if pair is not None:
            stamp_a, a, b = pair
            assert frames[a] == ('a', stamp_a) and frames[b][0] == 'b'
            stamps = stamp_a, frames[b][1]
            assert abs(stamps[0] - stamps[1]) <= slop_ns and a not in used and b not in used
            assert all(new > old for new, old in zip(stamps, last))
            assert all(frame >= oldest for kind, oldest in (u for u in used if isinstance(u, tuple))
                       for frame in (a, b))   # nothing from before a jump
            used |= {a, b}
            last, pairs = stamps, pairs + 1
        assert pairer.waiting <= 2 * BUFFER
    c = pairer.counts
    assert c.pairs == pairs and len(frames) == 2 * c.pairs + c.unpaired + c.duplicates + c.unstamped + pairer.waiting
    return c


@examples(2)
@given(streams(), st.sampled_from([0, 10, 20]))
def test_two_streams(frames, slop_ms):
    check_pairs(frames, slop_ms * MS)


@examples(2)
@given(st.lists(st.tuples(st.sampled_from(PLANES), ANY_STAMP), max_size=60), st.integers(0, 10**9))
def test_any_stamps_at_all(frames, slop_ns):
    counts = check_pairs(frames, slop_ns)
    assert counts.unstamped == sum(not 0 < stamp <= LAST_NS for _, stamp in frames)


@examples()
@given(streams())
def test_after_any_mess_the_second_good_pair_comes_out(frames):
    """As it does after a reset: a jump back is one by itself."""
    pairer = Pairer(10 * MS)
    for plane, stamp in frames:
        pairer.add(plane, stamp, None)
    for start in (T0 + 500 * 10**9, T0 - 500 * 10**9):
        for k in range(2):
            pairer.add('a', start + 66 * k * MS, f'a{k}')
            pair = pairer.add('b', start + 66 * k * MS, f'b{k}')
        assert pair == (start + 66 * MS, 'a1', 'b1')


@examples(2)
@given(st.lists(st.tuples(st.sampled_from(['pair', 'a', 'b', 'a', 'b', 'rewind']), st.integers(0, 60), st.floats(0, 1)),
                max_size=80))
def test_pairs_leave_the_room_in_order_once_and_in_time(events):
    """Pairs come with growing stamps, cameras with any; after each event somebody asks."""
    room, books, now, stamp, seen = WaitingRoom(), (CameraBook(), CameraBook()), 0.0, T0, []
    came = lost = 0
    since = None        # when the oldest of the pairs came that wait
    for kind, step, seconds in events:
        now += seconds
        if kind == 'pair':
            stamp, came = stamp + (step + 1) * MS, came + 1
            lost += room.add(Pair((stamp, stamp), (came, came), now))
            since = now if since is None else since
        elif kind == 'rewind':
            for book in books:
                book.rewind(T0)
        else:
            books['ab'.index(kind)].add(T0 + step * 10 * MS, step % 3)
        pair, overtaken = room.take(books, now)
        lost += overtaken
        assert len(room) <= ROOM and came == len(seen) + (pair is not None) + lost + len(room)
        if pair is not None:
            assert pair.items[0] > (seen[-1] if seen else 0)
            seen.append(pair.items[0])
            since = None if not len(room) else since
        assert since is None or pair is not None or now < since + PATIENCE_S or not len(room)
