"""Which camera holds for an image, and which pairs wait for theirs: hand-derived sequences."""

import pytest

from fluoro_shape_ros.ros.waiting import BUFFER, PATIENCE_S, CameraBook, Pair, WaitingRoom

MS = 1_000_000
T0 = 1_000_000 * MS


def book(*cameras):
    """A book that was given cameras as (ms, camera), in this order."""
    b = CameraBook()
    for ms, camera in cameras:
        b.add(T0 + ms * MS, camera)
    return b


@pytest.mark.parametrize('cameras, ms, holds', [
    ([], 0, None),
    ([(0, 'x')], 0, 'x'),
    ([(0, 'x')], 5000, 'x'),
    ([(66, 'x')], 0, 'x'),                                          # the only one there is
    ([(0, 'x'), (66, 'y')], 65, 'x'),                               # a change waits for the first image at or after it
    ([(0, 'x'), (66, 'y')], 66, 'y'),
    ([(66, 'y'), (0, 'x')], 65, 'x'),                               # late, but stamped before
    ([(0, 'x'), (66, 'x'), (133, 'y')], 132, 'x'),
    ([(0, 'x'), (0, 'y')], 0, 'y'),                                 # the same stamp: the later one
    ([(20000, 'x'), (20066, 'y'), (0, 'z')], 30000, 'z'),           # a jump back: what was later is forgotten
])
def test_which_camera_holds(cameras, ms, holds):
    assert book(*cameras).at(T0 + ms * MS) == holds


def test_camera_memory_is_bounded():
    b = book(*[(k, k) for k in range(400)])
    assert b.at(T0 + 399 * MS) == 399 and b.at(T0) == 400 - BUFFER


def test_an_image_waits_for_its_camera_only_where_cameras_come_with_images():
    b = book((0, 'x'))
    assert not b.awaits(T0 + 5)         # once and for all, as far as we know
    b = book((0, 'x'))
    assert not b.awaits(T0)             # stamped alike, so the next one will be, too
    assert b.awaits(T0 + 66 * MS)
    b.add(T0 + 66 * MS, 'y')
    assert not b.awaits(T0 + 66 * MS) and b.at(T0 + 66 * MS) == 'y'


def test_cameras_that_come_after_their_images_are_noticed():
    b = book((0, 'x'))
    assert not b.awaits(T0 + 66 * MS)
    b.add(T0 + 66 * MS, 'y')
    assert b.awaits(T0 + 133 * MS)


def test_waiting_can_be_given_up_and_begins_again():
    b = book((0, 'x'))
    assert not b.awaits(T0) and b.awaits(T0 + 66 * MS)
    b.give_up()
    assert not b.awaits(T0 + 66 * MS) and not b.awaits(T0 + 133 * MS)
    for ms in (200, 266, 333):      # most of the last four images have one again
        assert not b.awaits(T0 + (ms - 1) * MS)
        b.add(T0 + (ms - 1) * MS, 'x')
    assert b.awaits(T0 + 400 * MS)


def test_cameras_that_come_with_every_fifth_image_are_not_waited_for():
    b, waited = CameraBook(), []
    for k in range(40):
        if k % 5 == 0:
            b.add(T0 + k * MS, 'x')
        waited.append(b.awaits(T0 + k * MS))
    assert not any(waited[10:])


def test_before_any_camera_an_image_waits_until_it_is_given_up():
    b = CameraBook()
    assert b.awaits(T0)
    b.give_up()
    assert not b.awaits(T0 + 66 * MS)


def test_after_images_jumped_back_a_known_camera_goes_on():
    b = book((20000, 'x'), (20066, 'y'))
    b.rewind(T0)
    assert b.at(T0) == 'y' and b.at(T0 + 30000 * MS) == 'y'
    b.add(T0 + 66 * MS, 'x')
    assert (b.at(T0), b.at(T0 + 66 * MS)) == ('y', 'x')


def test_a_camera_that_came_from_behind_a_jump_before_its_image_is_kept():
    b = book((20000, 'x'), (0, 'y'), (66, 'z'))
    b.rewind(T0)
    assert (b.at(T0), b.at(T0 + 66 * MS)) == ('y', 'z') and not b.awaits(T0)


def room(*pairs):
    """A room that pairs came to, given as (stamp in ms, arrival in s)."""
    waiting = WaitingRoom()
    for ms, arrived in pairs:
        waiting.add(Pair((T0 + ms * MS,) * 2, (ms, ms), arrived))
    return waiting


def taken(waiting, books, now):
    pair, lost = waiting.take(books, now)
    return None if pair is None else pair.items[0], lost


def test_the_newest_pair_whose_cameras_came_goes_first():
    """Cameras that come more than a frame late must not keep every pair from its turn."""
    books = book((0, 'x')), book((0, 'x'))
    waiting = room((0, 0.0))
    assert taken(waiting, books, 0.0) == (0, 0)
    for ms in (66, 133, 200):
        waiting.add(Pair((T0 + ms * MS,) * 2, (ms, ms), ms / 1000))
        assert taken(waiting, books, ms / 1000) == (None, 0)
    for ms in (66, 133):
        books[0].add(T0 + ms * MS, 'y')
    assert taken(waiting, books, 0.2) == (None, 0)      # plane b's are still missing
    for ms in (66, 133):
        books[1].add(T0 + ms * MS, 'y')
    assert taken(waiting, books, 0.2) == (133, 1) and len(waiting) == 1


def test_patience_ends_also_while_newer_pairs_come():
    books, waiting = (CameraBook(), CameraBook()), WaitingRoom()
    answers = []
    for k in range(80):
        waiting.add(Pair((T0 + 66 * k * MS,) * 2, (k, k), 0.066 * k))
        answers.append(taken(waiting, books, 0.066 * k)[0])
    first = next(k for k, answer in enumerate(answers) if answer is not None)
    assert PATIENCE_S <= 0.066 * first < PATIENCE_S + 0.067 and answers[first:] == list(range(first, 80))


def test_a_room_is_bounded_and_forgets():
    waiting = room(*[(66 * k, 0.066 * k) for k in range(BUFFER)])
    assert waiting.add(Pair((T0,) * 2, (0, 0), 9.0)) == 1 and len(waiting) == BUFFER
    waiting.clear()
    assert len(waiting) == 0 and taken(waiting, (CameraBook(), CameraBook()), 99.0) == (None, 0)


def test_what_is_lost_for_good_is_waited_for_but_shortly():
    waiting, books = room((0, 0.0)), (CameraBook(), CameraBook())
    assert waiting.take(books, 0.1, lossy=True) == (None, 0)
    assert waiting.take(books, 0.3, lossy=False) == (None, 0)
    assert waiting.take(books, 0.3, lossy=True)[0].items == (0, 0)
