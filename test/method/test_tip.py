"""The tip rule, clause by clause."""

import numpy as np
import pytest

from fluoro_shape_ros.method.tip import tip_is_last

ENDS = np.array([[0.0, 0, 0], [0.1, 0, 0]])
INSIDE = np.array([[100.0, 100], [200, 200]])       # px from the border: the last end is farther inside
LINE = np.linspace(ENDS[0], ENDS[1], 11)


@pytest.mark.parametrize('at_border, last', [((True, False), True), ((False, True), False)])
def test_the_end_at_the_border_is_the_base_whatever_else_is_known(at_border, last):
    assert (tip_is_last(ENDS, at_border, lambda: INSIDE[::-1], base_position=ENDS[int(last)], previous=LINE[::-1])
            == (last, False))


@pytest.mark.parametrize('at_border', [(False, False), (True, True)])
@pytest.mark.parametrize('base, last', [((0.01, 0, 0), True), ((0.09, 0, 0), False)])
def test_then_the_end_farther_from_the_base_is_the_tip(at_border, base, last):
    assert (tip_is_last(ENDS, at_border, lambda: INSIDE, base_position=base, previous=LINE if not last else LINE[::-1])
            == (last, False))


@pytest.mark.parametrize('previous, last', [(LINE, True), (LINE[::-1], False), (LINE + 0.01, True)])
def test_then_the_previous_result_counts(previous, last):
    assert (tip_is_last(ENDS, (False, False), lambda: INSIDE[::-1] if last else INSIDE, previous=previous)
            == (last, False))


@pytest.mark.parametrize('border, last', [(INSIDE, True), (INSIDE[::-1], False)])
def test_else_it_is_a_guess_and_said_to_be_one(border, last):
    assert tip_is_last(ENDS, (False, False), lambda: border) == (last, True)
