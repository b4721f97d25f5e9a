"""Arrays in memory that two processes see; here two mappings of it in one."""

import os

import numpy as np
import pytest

from fluoro_shape_ros.ros.shared_arrays import ALIGNED, SeenArrays, SharedArrays


@pytest.fixture
def shared():
    shared = SharedArrays()
    yield shared
    shared.close()


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.float32])
def test_what_is_put_is_seen_as_it_is(shared, dtype):
    """Of any stride, and other sizes for both."""
    a, b = np.arange(35).astype(dtype).reshape(5, 7), np.arange(60).astype(dtype).reshape(6, 10)[:, ::2]
    places = shared.put((a, b))
    seen = SeenArrays(shared.fd).at(places)
    assert all(np.array_equal(x, y) and x.dtype == y.dtype for x, y in zip(seen, (a, b)))
    assert places[0].stop <= places[1].offset and all(place.offset % ALIGNED == 0 for place in places)


def test_it_grows_with_the_largest_and_is_seen_again(shared):
    seen, big = SeenArrays(shared.fd), np.arange(10_000, dtype=np.uint16).reshape(100, 100)
    for array in (big[:3], big, big[:7], big.astype(np.float32)):
        assert np.array_equal(seen.at(shared.put((array, array)))[1], array)
    assert os.fstat(shared.fd).st_size == 2 * 40_000


def test_the_other_side_can_not_write(shared):
    array, = SeenArrays(shared.fd).at(shared.put((np.zeros((2, 2)),)))
    with pytest.raises(ValueError, match='read-only'):
        array[0, 0] = 1


def test_it_has_no_name(shared):
    before = set(os.listdir('/dev/shm'))
    shared.put((np.zeros(1000),))
    assert set(os.listdir('/dev/shm')) <= before
    assert 'deleted' in os.readlink(f'/proc/self/fd/{shared.fd}')
