"""Where a device that moves evenly is expected."""

from dataclasses import replace

import numpy as np
import pytest

from fluoro_shape_ros.data import Prior, Shape
from fluoro_shape_ros.method.propose.motion import going_on

STEP = 10**9 // 15      # ns


def straight(tip=0.06, base=0.0, count=61):
    """A shape along x, m."""
    s = np.linspace(0, tip - base, count)
    return Shape(np.stack([base + s, 0 * s, 0 * s], axis=1), s, np.zeros((count, 3, 3)), np.zeros((count, 2)))


def lifted(shape, z):
    return replace(shape, points=shape.points + [0, 0, z])


STILL = Prior(straight(), 2 * STEP, straight(), STEP)


def test_what_stands_still_stays():
    assert np.allclose(going_on(STILL, 3 * STEP), straight().points, atol=1e-12)


def test_what_moves_evenly_goes_on():
    assert np.allclose(going_on(replace(STILL, previous=lifted(straight(), 0.002)), 3 * STEP),
                       lifted(straight(), 0.004).points, atol=1e-12)


def test_after_a_missed_pair_it_is_twice_as_far():
    assert np.allclose(going_on(replace(STILL, previous=lifted(straight(), 0.002)), 4 * STEP),
                       lifted(straight(), 0.006).points, atol=1e-12)


def test_an_inserted_device_grows_on_at_its_tip():
    points = going_on(replace(STILL, previous=straight(0.063, count=64)), 3 * STEP)
    assert np.allclose(points[[0, -1]], [[0, 0, 0], [0.066, 0, 0]], atol=1e-12)


@pytest.mark.parametrize('prior', [
    Prior(), replace(STILL, previous=None), replace(STILL, before=None),
    replace(STILL, before_stamp_ns=2 * STEP), replace(STILL, before_stamp_ns=4 * STEP),         # no time, or backwards
    replace(STILL, before_stamp_ns=2 * STEP - 10**9),                                           # long ago
    replace(STILL, previous_stamp_ns=-STEP, before_stamp_ns=-2 * STEP),                         # several pairs missed
    # the stamps stand or jump back
    replace(STILL, previous_stamp_ns=3 * STEP), replace(STILL, previous_stamp_ns=5 * STEP),
    replace(STILL, previous=lifted(straight(), 0.009)),                                         # faster than anything
], ids=range(10))
def test_what_does_not_tell_a_velocity_expects_nothing(prior):
    assert going_on(prior, 3 * STEP) is None
