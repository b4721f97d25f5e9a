"""What is shown, against hand-derived places: sources, detectors, ellipsoids, close-ups."""

import numpy as np
import pytest

pytest.importorskip('rerun')
from drawing import SIZE, VIEWS, curve
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.geometry.cameras import make_view, project
from fluoro_shape_ros.view import scene

A, B = (make_view(name, P, SIZE, SIZE) for name, P in zip('ab', VIEWS))
CHI2 = 7.814728     # of three degrees of freedom, 95 %


def numbers(batch):
    """What an archetype's component holds."""
    return np.array(batch.as_arrow_array().to_pylist(), float)


def lines(archetype):
    return [np.array(line, float) for line in archetype.strips.as_arrow_array().to_pylist()]


def test_sources_stand_where_the_planes_look_from_and_detectors_behind_the_isocentre():
    shown = scene.cameras((A, B))
    np.testing.assert_allclose(numbers(shown['source_a'].positions), [[0.0, -0.8, 0.0]], atol=1e-6)
    np.testing.assert_allclose(numbers(shown['source_b'].positions), [[-0.8, 0.0, 0.0]], atol=1e-6)
    outline, *edges = lines(shown['detector_a'])
    # behind it, and parallel to the image
    np.testing.assert_allclose(outline[:, 1], 0.8 * (scene.DETECTOR_AT - 1), atol=1e-6)
    half = SIZE / 2 * scene.DETECTOR_AT * 1e-3      # a pixel is 1 mm at the isocentre
    assert np.abs(outline[:, [0, 2]]).max() == pytest.approx(half, abs=1e-6) and len(edges) == 4
    np.testing.assert_allclose(project(A.P, outline[[0, 2]]), [[-0.5, -0.5], [SIZE - 0.5] * 2], atol=1e-3)


def test_the_pinhole_of_a_plane_projects_as_its_camera_does():
    pinhole, place, *_ = scene.cameras((A, B))['plane_b']
    K = numbers(pinhole.image_from_camera).reshape(3, 3).T              # columns first
    axes, origin = numbers(place.mat3x3).reshape(3, 3).T, numbers(place.translation)[0]
    points = curve()[::50]
    seen = (points - origin) @ axes @ K.T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], project(B.P, points), atol=1e-3)


def test_a_mirrored_image_is_shown_but_not_on_its_detector():
    mirrored = make_view('a', np.array([[-1, 0, SIZE - 1], [0, 1, 0], [0, 0, 1.0]]) @ VIEWS[0], SIZE, SIZE)
    shown = scene.cameras((mirrored, B))
    assert 'plane_a' not in shown and {'source_a', 'detector_a', 'plane_b'} <= shown.keys()
    np.testing.assert_allclose(numbers(shown['source_a'].positions), [[0.0, -0.8, 0.0]], atol=1e-6)


@pytest.mark.parametrize('P, up', [(VIEWS[0], 'RIGHT_HAND_Z_UP'),
                                   (np.c_[np.diag([800.0, 800.0, 1.0]), np.zeros(3)], 'RIGHT_HAND_Y_DOWN')])
def test_up_is_what_is_up_in_the_image(P, up):
    assert scene.upright(make_view('a', P, SIZE, SIZE))[''] is getattr(scene.rr.ViewCoordinates, up)


def test_the_ellipsoid_is_that_of_the_covariance():
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    covariance = turn @ np.diag([1e-8, 4e-8, 9e-8]) @ turn.T
    shown = scene.ellipsoid(np.array([0.1, 0.2, 0.3]), covariance)
    for path, unit in (('device/ellipsoid', 1.0), ('tip/ellipsoid', 1e3)):
        half = numbers(shown[path].half_sizes)[0] / unit
        np.testing.assert_allclose(half, np.sqrt(CHI2) * np.array([1e-4, 2e-4, 3e-4]), rtol=1e-5)
        axes = Rotation.from_quat(numbers(shown[path].quaternions)[0]).as_matrix()
        np.testing.assert_allclose(axes @ np.diag(half**2) @ axes.T, CHI2 * covariance, atol=1e-5 * CHI2 * 9e-8)
    np.testing.assert_allclose(numbers(shown['device/ellipsoid'].centers), [[0.1, 0.2, 0.3]], atol=1e-6)


@pytest.mark.parametrize('covariance', [np.full((3, 3), np.nan), 1e6 * np.eye(3)])
def test_what_is_not_known_of_the_tip_is_not_shown(covariance):
    assert all(isinstance(archetype, scene.rr.Clear) for archetype in scene.ellipsoid(np.zeros(3), covariance).values())
    assert len(lines(scene.drawn_tip(A, curve()[-1], covariance)['plane_a/tip'])) == 1      # the ring alone


def test_the_ring_and_the_ellipse_of_the_tip_in_an_image():
    ring, ellipse = lines(scene.drawn_tip(A, np.zeros(3), 1e-6 * np.eye(3))['plane_a/tip'])
    center = (SIZE - 1) / 2
    np.testing.assert_allclose(np.linalg.norm(ring - center, axis=1), scene.RING_PX, atol=1e-3)
    # sigma is 1 mm, which is 1 px; two degrees of freedom
    np.testing.assert_allclose(np.linalg.norm(ellipse - center, axis=1), np.sqrt(5.991465), atol=1e-3)


def test_the_close_up_shows_the_last_millimetres_from_the_tip():
    line = np.c_[np.zeros(101), np.zeros(101), np.linspace(0.0, 0.1, 101)]
    near = scene.close_up(line, line[-1])
    np.testing.assert_allclose(near, np.c_[np.zeros(11), np.zeros(11), np.linspace(-2.0, 0.0, 11)], atol=1e-9)
    shown = scene.truth(line, line[-1] + [0.0, 0.001, 0.0])     # the true tip lies 1 mm beside the one that was found
    np.testing.assert_allclose(numbers(shown['tip/true_tip'].positions), [[0.0, -1.0, 0.0]], atol=1e-5)
    assert np.abs(scene.close_up(line[-2:], line[-1])).max() == pytest.approx(1.0)      # all there is


def test_the_backbone_is_drawn_where_it_is_seen():
    (line,) = lines(scene.drawn(B, curve())['plane_b/backbone'])
    np.testing.assert_allclose(line, project(B.P, curve()), atol=1e-3)


def test_numbers_that_are_not_known_are_left_out():
    assert list(scene.values(milliseconds__here=3.0, confidence__published=np.nan)) == ['milliseconds/here']


def test_every_outcome_has_a_colour_and_nodes_have_tabs_of_their_own():
    assert {f'pairs/{outcome.value}' for outcome in scene.Outcome} <= scene.styles().keys()
    assert ([type(scene.layout(roots).root_container).__name__ for roots in (['one'], ['one', 'two'])]
            == ['Vertical', 'Tabs'])
