"""Where the device was, as a term of the judge: hand-derived values, and what it does to a pair."""

import numpy as np
import pytest
from drawing import GOOD, RADIUS, SIZE, VIEWS, curve
from numpy.testing import assert_allclose

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome, Prior, Shape
from fluoro_shape_ros.geometry.cameras import make_view
from fluoro_shape_ros.method.continuity import FASTEST, LEAPS, continuity
from fluoro_shape_ros.method.features import TIP
from fluoro_shape_ros.method.pipeline import reconstruct

LINE = np.linspace([0, 0, 0], [0, 0, 0.05], 51)
SECOND = 1_000_000_000


def was(points, stamp_ns=0):
    return Prior(Shape(points, np.zeros(len(points)), np.zeros((len(points), 3, 3)), np.zeros((len(points), 2))),
                 stamp_ns)


def test_nothing_is_said_of_what_is_not_known():
    assert continuity(LINE, Prior(), SECOND) == 0
    assert continuity(LINE + 1, was(LINE, SECOND), SECOND) == 0 == continuity(LINE + 1, was(LINE, 2 * SECOND), SECOND)


@pytest.mark.parametrize('seconds', [1 / 60, 1 / 15, 1.0])
def test_what_it_can_have_moved_by_costs_nothing(seconds):
    assert (continuity(LINE + [FASTEST * seconds, 0, 0], was(LINE), round(seconds * SECOND))
            == pytest.approx(0, abs=1e-12))


def test_a_leap_is_as_likely_as_leaps_are():
    for seconds in (0.1, 1.0, 20.0):
        assert_allclose(continuity(LINE + [50, 0, 0], was(LINE), round(seconds * SECOND)),
                        np.log(1 - np.exp(-LEAPS * seconds)), rtol=1e-9, atol=1e-12)


def test_beyond_its_reach_it_is_a_gaussian():
    seconds, reach = 0.1, FASTEST * 0.1 + TIP
    leap = 1 - np.exp(-LEAPS * seconds)
    assert_allclose(continuity(LINE + [2.5 * reach, 0, 0], was(LINE), round(seconds * SECOND)),
                    np.log(leap + (1 - leap) * np.exp(-0.5 * 1.5**2)), rtol=1e-9)


def test_which_end_is_the_tip_is_another_question():
    assert continuity(LINE[::-1], was(LINE), SECOND // 60) == 0


def test_a_tip_that_leaps_along_the_device_counts_too():
    assert continuity(LINE[:20], was(LINE), SECOND // 60) < -2


def test_what_is_found_elsewhere_needs_more_evidence_an_eye_blink_later_and_none_some_time_later():
    frame = lambda stamp_ns: Frame(stamp_ns, 'cell', tuple(GOOD),    # noqa: E731
                                   tuple(make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS)))
    config = Config.from_values(robot_radius=RADIUS, base_position=curve()[0].tolist(), min_confidence=0.01)
    alone, elsewhere = reconstruct(frame(SECOND), config), was(curve() + [0, 0.2, 0.2], 0)
    confidence = [reconstruct(frame(stamp_ns), config, elsewhere).confidence
                  for stamp_ns in (SECOND // 30, SECOND // 2, 60 * SECOND)]
    assert confidence[0] < confidence[1] < confidence[2] == pytest.approx(alone.confidence, abs=1e-6)
    strict = config.replace(min_confidence=0.5 * (confidence[0] + alone.confidence))
    result = reconstruct(frame(SECOND // 30), strict, elsewhere)
    assert result.outcome is Outcome.LOW_CONFIDENCE and result.detail == 'it is far from where it was just before'
