"""What messages of a node make of the view, in the messages of ROS and of bags."""

import numpy as np
import pytest

rerun = pytest.importorskip('rerun')
import cv2
from drawing import CALIBRATIONS, GOOD, SIZE, VIEWS, curve

from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.geometry.cameras import make_view
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.overlay import overlay
from fluoro_shape_ros.view.node_view import NodeView
from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.diagnostics import (
    OK,
    STALE,
    WARN,
    ReconstructionSummary,
    Status,
    diagnostic_array,
    reconstruction_status,
)
from msg_adapters.images import array_to_image
from msg_adapters.shapes import shape_to_cloud, shape_to_path, shape_to_tip_pose

SECOND = 10**9
S = np.linspace(0.0, arc_length(curve())[-1], 50)
SHAPE = Shape(at_arc_length(curve(), S), S, np.tile(1e-8 * np.eye(3), (50, 1, 1)), np.zeros((50, 2)))
PAIR = tuple(make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS))


class Heard:
    """What a NodeView logs, in order, as (stamp, path, archetypes)."""

    def __init__(self, namespace='/'):
        self.all = []
        self.view = NodeView(lambda stamp, things: self.all.extend((stamp, path, archetypes)
                                                                   for path, archetypes in things.items()), namespace)
        self.all.clear()

    def at(self, stamp):
        """The newest archetype of every path at a stamp."""
        return {path.removeprefix('fluoro_shape/'): archetypes for when, path, archetypes in self.all if when == stamp}

    def values(self, path):
        """The numbers logged at a path, by stamp."""
        return {stamp: archetypes.scalars.as_arrow_array().to_pylist()[0] for stamp, name, archetypes in self.all
                if name == f'fluoro_shape/{path}'}

    def texts(self):
        return [archetypes.text.as_arrow_array().to_pylist()[0] for _, path, archetypes in self.all
                if path.endswith('/log')]


@pytest.fixture
def heard():
    return Heard()


def cameras(heard, new, stamp=SECOND):
    for plane, calibration in zip('ab', CALIBRATIONS):
        heard.view.take(f'plane_{plane}/camera_info',
                        calibration_to_camera_info(calibration, stamp, f'plane_{plane}', new), stamp)


def overlays(heard, new, stamp, result):
    for k, plane in enumerate('ab'):
        picture = overlay(GOOD[k], k, result, PAIR)
        heard.view.take(f'plane_{plane}/overlay', array_to_image(picture, stamp, 'world', new), stamp)
    return picture


def result(heard, new, stamp, confidence=0.97, arrived_ns=None):
    heard.view.take('tip_pose', shape_to_tip_pose(SHAPE, stamp, 'world', new), stamp)
    heard.view.take('backbone_points', shape_to_cloud(SHAPE, confidence, stamp, 'world', new),
                    stamp if arrived_ns is None else arrived_ns)


def diagnostics(heard, new, stamp, status, node='/fluoro_shape'):
    heard.view.take('/diagnostics', diagnostic_array([status], stamp, node, new), stamp)


def of_replay(outcome, detail='', confidence=''):
    level = OK if outcome is Outcome.OK else WARN
    return Status('reconstruction', level, f'{outcome.value}: {detail}',
                  {'last outcome': outcome.value, 'last detail': detail, 'confidence': confidence, 'warnings': ''})


def is_cleared(archetypes):
    return isinstance(archetypes, rerun.Clear)


def test_a_result_is_shown_at_its_stamp_with_its_numbers(heard, new):
    cameras(heard, new)
    result(heard, new, SECOND, arrived_ns=SECOND + 40_000_000)
    shown = heard.at(SECOND)
    assert {'source_a', 'source_b', 'plane_a', 'plane_b', 'device/backbone', 'device/tip', 'device/ellipsoid',
            'tip/backbone', 'tip/ellipsoid'} <= shown.keys()
    assert {path: round(heard.values(path)[SECOND], 4)
            for path in ('confidence/published', 'millimetres/tip_sigma', 'millimetres/sigma',
                         'milliseconds/here')} == {
                             'confidence/published': 0.97, 'millimetres/tip_sigma': 0.1, 'millimetres/sigma': 0.1,
                             'milliseconds/here': 40.0}
    np.testing.assert_allclose(shown['device/tip'].positions.as_arrow_array().to_pylist(), [SHAPE.tip], atol=1e-6)


def test_cameras_are_drawn_again_only_where_they_move(heard, new):
    for second in (1, 2):
        cameras(heard, new, second * SECOND)
        result(heard, new, second * SECOND)
    assert 'source_a' in heard.at(SECOND) and 'source_a' not in heard.at(2 * SECOND)


def test_errors_are_those_against_the_truth_of_the_same_stamp_in_either_order(heard, new):
    beside = Shape(SHAPE.points + [0.0, 0.0, 0.002], SHAPE.s, SHAPE.covariance, SHAPE.residuals_px)
    for stamp, steps in ((SECOND, (0, 1)), (2 * SECOND, (1, 0))):
        for step in steps:
            if step:
                result(heard, new, stamp)
            else:
                heard.view.take('ground_truth/backbone', shape_to_path(beside, stamp, 'world', new), stamp)
    assert heard.values('millimetres/tip_error') == pytest.approx({SECOND: 2.0, 2 * SECOND: 2.0}, rel=1e-4)
    assert all(0.0 < value < 2.0 for value in heard.values('millimetres/error').values())


def test_an_overlay_without_a_result_takes_the_device_away(heard, new):
    result(heard, new, SECOND)
    overlays(heard, new, SECOND, Reconstruction(Outcome.OK, shape=SHAPE))
    overlays(heard, new, 2 * SECOND, Reconstruction(Outcome.LOW_CONFIDENCE, 'the planes disagree'))
    assert not is_cleared(heard.at(SECOND)['device/backbone']) and 'device' not in heard.at(SECOND)
    assert is_cleared(heard.at(2 * SECOND)['device']) and is_cleared(heard.at(2 * SECOND)['tip'])


def test_an_overlay_keeps_its_colours(heard, new):
    picture = overlays(heard, new, SECOND, Reconstruction(Outcome.OK, shape=SHAPE))
    blob = heard.at(SECOND)['plane_b/picture'].blob.as_arrow_array().to_pylist()[0]
    shown = cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown.astype(float) - picture).mean() < 3.0
    assert np.ptp(picture.astype(int), axis=2).max() > 100      # there is colour in it


def test_where_there_are_only_images_backbone_and_tip_are_drawn_on_them(heard, new):
    cameras(heard, new)
    for plane, pixels in zip('ab', GOOD):
        heard.view.take(f'plane_{plane}/image_raw', array_to_image(pixels, SECOND, 'world', new), SECOND)
    result(heard, new, SECOND)
    assert ({'plane_a/picture', 'plane_a/backbone', 'plane_a/tip', 'plane_b/backbone', 'plane_b/tip'}
            <= heard.at(SECOND).keys())


def test_a_replay_tells_of_every_pair(heard, new):
    result(heard, new, SECOND)
    for second, status in enumerate([of_replay(Outcome.OK, confidence='0.97'),
                                     of_replay(Outcome.NO_DEVICE_A, 'no line of at least 60 px'),
                                     of_replay(Outcome.NO_DEVICE_A, 'no line of at least 61 px'),
                                     of_replay(Outcome.LOW_CONFIDENCE, 'the ends differ', '0.4')], start=1):
        diagnostics(heard, new, second * SECOND, status)
    assert heard.values('pairs/no_device_in_plane_a') == {2 * SECOND: 1, 3 * SECOND: 2, 4 * SECOND: 2}
    assert heard.values('confidence/refused') == {4 * SECOND: 0.4}
    assert [is_cleared(heard.at(second * SECOND).get('device')) for second in (1, 2, 3, 4)] == [False, True, True, True]
    assert heard.texts() == ['ok', 'no_device_in_plane_a: no line of at least 60 px',
                             'confidence_too_low: the ends differ']     # once for the same reason


def test_a_node_sums_up_once_a_second(heard, new):
    summary = ReconstructionSummary(outcome=Outcome.LOW_CONFIDENCE, detail='the ends differ', confidence=0.4,
                                    silent_s=0.1, rate_hz=2.0,
                                    latency_s=(0.03, 0.05, 0.04), outcomes={'ok': 7, 'confidence_too_low': 2})
    result(heard, new, SECOND)
    overlays(heard, new, SECOND, Reconstruction(Outcome.OK, shape=SHAPE))
    diagnostics(heard, new, 2 * SECOND, reconstruction_status(summary))
    assert heard.values('milliseconds/node') == {2 * SECOND: 40.0}
    assert heard.values('pairs/ok') == {2 * SECOND: 7} and heard.values('pairs/confidence_too_low') == {2 * SECOND: 2}
    assert heard.values('confidence/refused') == {2 * SECOND: 0.4}
    assert 'device' not in heard.at(2 * SECOND)     # the overlay of the refused pair takes it away


def test_nothing_stale_stays_and_the_stamps_of_a_played_bag_count(heard, new):
    result(heard, new, SECOND)
    diagnostics(heard, new, 10**9 * SECOND, Status('reconstruction', STALE, 'no pair for 3 s',
                                                   {'last outcome': 'ok', 'mask': 'none'}))
    assert is_cleared(heard.at(SECOND + 1)['device']) and not heard.at(10**9 * SECOND)


@pytest.mark.parametrize('node, meant', [('/lab/fluoro_shape', True), ('/lab/other/fluoro_shape', False),
                                         ('/fluoro_shape', False)])
def test_diagnostics_of_other_namespaces_are_not_heard(new, node, meant):
    heard = Heard('/lab')
    diagnostics(heard, new, SECOND, of_replay(Outcome.OK), node)
    assert heard.view.heard == meant and bool(heard.all) == meant
    assert all(path.startswith('lab/') for _, path, _ in heard.all)


def test_what_makes_no_sense_is_left_out(heard, new):
    cloud = shape_to_cloud(SHAPE, 0.9, SECOND, 'world', new)
    cloud.width -= 1
    heard.view.take('backbone_points', cloud, SECOND)
    picture = array_to_image(np.zeros((4, 4, 3), np.uint8), SECOND, 'world', new)
    picture.height = 5
    heard.view.take('plane_a/overlay', picture, SECOND)
    lost = Shape(SHAPE.points * np.nan, SHAPE.s, SHAPE.covariance, SHAPE.residuals_px)
    heard.view.take('tip_pose', shape_to_tip_pose(lost, SECOND, 'world', new), SECOND)
    info = calibration_to_camera_info(CALIBRATIONS[0], SECOND, 'plane_a', new)
    info.p = np.zeros(12)
    heard.view.take('plane_a/camera_info', info, SECOND)
    assert not [path for _, path, archetypes in heard.all if not is_cleared(archetypes)]
    diagnostics(heard, new, SECOND, Status('reconstruction', WARN, 'of another program',
                                           {'mask': '', 'count ok': 'many', 'latency median (ms)': '?'}))
    assert heard.texts() == ['of another program']
