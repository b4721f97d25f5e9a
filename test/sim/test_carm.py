"""C-arm geometry by hand."""

import numpy as np
import pytest

from fluoro_shape_ros.geometry.cameras import decompose, isocenter, pixels_per_metre, plane_angle, project, source
from fluoro_shape_ros.sim import carm

ARM = carm.CArm(sid=1.2, sod=0.8, pixel_size_iso=0.4e-3, width=801, height=601)


def test_isocentre_is_the_image_centre():
    for v in carm.biplane((0.3, -0.2), (1.9, 0.4), ARM):
        np.testing.assert_allclose(project(v.P, np.zeros(3)), [400, 300], atol=1e-9)


def test_frontal_view():
    v = carm.view('a', 0.0, arm=ARM)
    np.testing.assert_allclose(source(v.P), [0, 0.8, 0], atol=1e-12)    # behind the patient
    right_and_down = np.array([[-0.04, 0, 0], [0, 0, -0.04]])           # to the patient's right, to the feet
    np.testing.assert_allclose(project(v.P, right_and_down), [[500, 300], [400, 400]], atol=1e-9)


@pytest.mark.parametrize('primary, secondary, at', [
    (90, 0, (-0.8, 0, 0)),          # LAO 90: the detector on the patient's left, the source on the right
    (-90, 0, (0.8, 0, 0)),
    (0, 90, (0, 0, -0.8)),          # cranial: the detector at the head
    (0, 30, (0, 0.8 * np.cos(np.pi / 6), -0.4)),
])
def test_where_the_source_stands(primary, secondary, at):
    np.testing.assert_allclose(source(carm.view('a', np.deg2rad(primary), np.deg2rad(secondary), ARM).P), at,
                               atol=1e-12)


def test_pixel_sizes_at_isocentre_and_detector():
    assert ARM.pixel_size == pytest.approx(0.6e-3)
    v = carm.view('a', 0.7, 0.2, ARM)
    assert pixels_per_metre(v.P, np.zeros((1, 3))) == pytest.approx(1 / 0.4e-3)
    at_detector = -source(v.P) * 0.4 / 0.8
    assert pixels_per_metre(v.P, at_detector[None]) == pytest.approx(1 / 0.6e-3)


def test_no_mirror_and_square_pixels():
    for v in carm.biplane((0.3, -0.2), (1.9, 0.4), ARM):
        K, R, _ = decompose(v.P)
        np.testing.assert_allclose(K, [[2000, 0, 400], [0, 2000, 300], [0, 0, 1]], atol=1e-6)
        assert np.linalg.det(R) == pytest.approx(1)


def test_angle_between_planes():
    views = carm.biplane((-0.2, 0), (0.9, 0), ARM)
    assert plane_angle(views) == pytest.approx(1.1)
    np.testing.assert_allclose(isocenter(views), 0, atol=1e-9)
    assert (views[0].name, views[1].name, views[0].width, views[0].height) == ('a', 'b', 801, 601)


@pytest.mark.parametrize('wrong', [{'sod': 1.3}, {'sod': 0.0}, {'pixel_size_iso': 0.0}, {'width': 0}])
def test_impossible_arms_are_refused(wrong):
    with pytest.raises(ValueError, match='no C-arm|no detector'):
        carm.CArm(**wrong)


def test_a_device_at_the_source_casts_no_shadow():
    v = carm.view('a', 0.0, arm=ARM)
    with pytest.raises(ValueError, match='plane a: the device reaches the X-ray source'):
        carm.shadow_box(v, np.array([[0, 0, 0], [0, 0.9, 0.0]]), 1e-3)
    assert carm.shadow_box(v, np.array([[1.0, 0, 0], [1.1, 0, 0]]), 1e-3) is None
