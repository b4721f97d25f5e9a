"""CameraInfo to View, against pixels derived by hand."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.geometry.cameras import distort, project, undistort
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view, check_lengths
from msg_adapters.messages import header

K = np.array([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]])
P = K @ np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])     # looks along +z from z = -1 m
X = np.array([[0.02, -0.01, 0.0]])                                 # seen at (340, 230)


@pytest.fixture
def info(new):
    """Makes a CameraInfo of 640x480; fields may be given, roi as (x, y, width, height)."""

    def make(roi=None, **fields):
        if roi is not None:
            fields['roi'] = new('sensor_msgs/msg/RegionOfInterest',
                                **dict(zip(('x_offset', 'y_offset', 'width', 'height'), roi)))
        fields = dict(width=640, height=480, k=K, p=P) | {k: np.asarray(v, float) if k in 'dkrp' else v
                                                          for k, v in fields.items()}
        return new('sensor_msgs/msg/CameraInfo', **fields)

    return make


def view(msg, shape=(480, 640), **options):
    return camera_info_to_view(msg, 'a', shape, **options)


def test_p_maps_the_reference_frame_to_pixels(info):
    v = view(info())
    assert (v.name, v.width, v.height, v.distortion) == ('a', 640, 480, None)
    assert_allclose(project(v.P, X), [[340, 230]])


def test_roi_shifts_the_pixels(info):
    v = view(info(roi=(100, 50, 300, 200)), (200, 300))
    assert (v.width, v.height) == (300, 200)
    assert_allclose(project(v.P, X), [[240, 180]])


def test_binning_joins_pixels(info):
    # 2x4 binning: columns 340 and 341 make column 170, so that 340 lies a quarter left of its centre; rows 228 to 231
    # make row 57
    v = view(info(binning_x=2, binning_y=4), (120, 320))
    assert_allclose(project(v.P, X), [[169.75, 57.125]])


def test_roi_and_binning_together(info):
    # 340 - 101 = 239 is the right one of columns 238 and 239: a quarter right of column 119; 230 - 51 = 179 likewise
    v = view(info(roi=(101, 51, 300, 200), binning_x=2, binning_y=2), (100, 150))
    assert_allclose(project(v.P, X), [[119.25, 89.25]])


def test_binning_rounds_the_size_down(info):
    assert view(info(width=641, binning_x=2, binning_y=1), (480, 320)).width == 320


def test_binning_agrees_with_averaging_an_image(info):
    """A blob painted where P says, averaged in 2x2 blocks, has its centre where the view of the binned image says."""
    v, u = np.mgrid[:480, :640]
    blob = np.exp(-((u - 340) ** 2 + (v - 230) ** 2) / 50).reshape(240, 2, 320, 2).mean(axis=(1, 3))
    v, u = np.mgrid[:240, :320]
    centre = np.array([(blob * u).sum(), (blob * v).sum()]) / blob.sum()
    assert_allclose(project(view(info(binning_x=2, binning_y=2), (240, 320)).P, X)[0], centre, atol=1e-6)


def test_a_pose_replaces_the_one_in_p(info):
    # camera at x = -1 m of the reference frame, looking along its +x; its x axis along -y, its y axis along -z
    R, t = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]]), np.array([0, 0, 1.0])
    v = view(info(), pose=(R, t))
    assert_allclose(project(v.P, np.array([[0.0, 0.02, 0.01], [1.0, 0.02, 0.01]])), [[300, 230], [310, 235]])


def test_mono_calibration_needs_a_pose(info):
    """P of a single camera has no translation: with the pose only its left 3x3 counts."""
    assert_allclose(view(info(p=np.c_[K, [-50.0, 0, 0]]), pose=(np.eye(3), [0, 0, 1.0])).P, P)


def test_a_pose_in_p_beside_the_one_given_is_refused(info):
    turned = K @ np.c_[cv2.Rodrigues(np.array([0, 0.1, 0]))[0], [0, 0, 1.0]]
    with pytest.raises(BadCameraInfo, match='plane a: .* holds a rotation'):
        view(info(p=turned), pose=(np.eye(3), [0, 0, 1.0]))


DISTORTIONS = {'plumb_bob': [-0.2, 0.05, 0.001, -0.002, 0.01],
               'rational_polynomial': [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001],
               'equidistant': [-0.05, 0.01, 0.002, -0.001]}


@pytest.mark.parametrize('model', DISTORTIONS)
@pytest.mark.parametrize('window', [dict(), dict(roi=(100, 50, 320, 240), binning_x=2, binning_y=2)],
                         ids=['full', 'roi and binning'])
def test_distortion_there_and_back(info, model, window):
    v = view(info(distortion_model=model, d=DISTORTIONS[model], **window), (120, 160) if window else (480, 640))
    ideal = np.array([[5.0, 7.0], [100.0, 60.0], [159.0, 119.0]])
    received = distort(v, ideal)
    assert np.abs(received - ideal).max() > 0.1
    assert_allclose(undistort(v, received), ideal, atol=1e-4)


def test_radial_distortion_by_hand(info):
    # k1 = -0.5 at x = 0.2, y = 0: r^2 = 0.04, x' = 0.2 (1 - 0.02) = 0.196
    v = view(info(distortion_model='plumb_bob', d=[-0.5, 0, 0, 0]))
    assert_allclose(distort(v, np.array([[520.0, 240.0]])), [[516, 240]], atol=1e-9)


def test_distortion_counts_from_the_full_image(info):
    """The same device point, in the full image and in a binned region of it."""
    given = dict(distortion_model='plumb_bob', d=DISTORTIONS['plumb_bob'])
    whole, part = view(info(**given)), view(info(roi=(100, 50, 320, 240), binning_x=2, binning_y=2, **given),
                                            (120, 160))
    seen, seen_in_part = distort(whole, project(whole.P, X)), distort(part, project(part.P, X))
    assert_allclose(seen_in_part, (seen - [100, 50] + 0.5) / 2 - 0.5, atol=1e-9)


def test_rectifying_rotation_agrees_with_opencv(info):
    R = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]
    v = view(info(distortion_model='plumb_bob', d=DISTORTIONS['plumb_bob'], r=R))
    raw = np.array([[[100.0, 80.0]], [[500.0, 400.0]]])
    assert_allclose(undistort(v, raw[:, 0]),
                    cv2.undistortPoints(raw, K, np.array(DISTORTIONS['plumb_bob']), R=R, P=K)[:, 0], atol=0.01)


def test_a_rotation_alone_turns_the_rays(info):
    # 0.1 rad about the optical axis: the principal point stays, (420, 240) turns around it
    R = cv2.Rodrigues(np.array([0, 0, 0.1]))[0]
    v = view(info(r=R))
    assert_allclose(undistort(v, np.array([[320.0, 240], [420.0, 240]])),
                    [[320, 240], [320 + 100 * np.cos(0.1), 240 + 100 * np.sin(0.1)]], atol=1e-6)


@pytest.mark.parametrize('fields', [
    dict(distortion_model='plumb_bob', d=np.zeros(5)),
    dict(distortion_model='equidistant', d=np.zeros(4), r=np.eye(3)),
    dict(distortion_model='', d=np.zeros(5)),
    dict(distortion_model='plumb_bob', d=[], r=np.zeros(9)),
], ids=str)
def test_no_distortion(info, fields):
    assert view(info(**fields)).distortion is None


def test_a_rectified_image_has_none(info):
    assert view(info(distortion_model='what', d=[1.0], r=cv2.Rodrigues(np.ones(3))[0]),
                rectified=True).distortion is None


@pytest.mark.parametrize('fields, says', [
    (dict(width=0), 'size in CameraInfo is 0x480'),
    (dict(height=0), 'size in CameraInfo is 640x0'),
    (dict(width=600), '600x480 images.*the image is 640x480'),
    (dict(roi=(0, 0, 320, 240)), '320x240 images'),
    (dict(binning_x=2, binning_y=2), '320x240 images'),
    (dict(roi=(400, 0, 320, 480)), 'roi .320x480 at 400, 0. leaves'),
    (dict(k=np.zeros(9)), 'K is zero'),
    (dict(p=np.zeros(12)), 'P is zero'),
    (dict(k=np.full(9, np.nan)), 'K has entries that are not finite'),
    (dict(p=np.where(np.eye(3, 4), np.inf, P)), 'P has entries that are not finite'),
    (dict(k=np.diag([1000.0, 0, 1])), 'K is singular'),
    (dict(p=P * [[1], [0], [1]]), 'P is singular'),
    (dict(p=np.diag([0.5, 0.5, 1]) @ np.eye(3, 4)), 'focal length of 0.5 px'),
    (dict(distortion_model='kannala_brandt', d=[0.1, 0, 0, 0]), 'kannala_brandt.*equidistant'),
    (dict(distortion_model='plumb_bob', d=[0.1, 0, 0]), 'plumb_bob has 3 coefficients instead of 4 or 5'),
    (dict(distortion_model='rational_polynomial', d=[0.1, 0, 0, 0, 0]), '5 coefficients instead of 8'),
    (dict(distortion_model='equidistant', d=[0.1] * 5), '5 coefficients instead of 4'),
    (dict(distortion_model='plumb_bob', d=[0.1, 0, 0, np.nan]), 'D has entries that are not finite'),
    (dict(d=[0.1, 0, 0, 0]), 'no distortion model'),
    (dict(r=2 * np.eye(3)), 'R is no rotation'),
    # its square overflows, and NaN is not above any limit
    (dict(r=np.diag([1.3e154, 1, 1])), 'R has entries beyond 1e\\+12'),
    (dict(binning_x=10**6), 'leaves no pixel'),
    (dict(r=np.diag([1.0, 1, -1])), 'R is no rotation'),
], ids=str)
def test_what_can_not_be_a_camera_is_named(info, fields, says):
    with pytest.raises(BadCameraInfo, match=f'plane a: .*({says})'):
        view(info(**fields))


@pytest.mark.parametrize('fields, says', [(dict(d=np.zeros(100_000)), 'D has 100000'),
                                          (dict(header='x' * 1000), 'frame_id has 1000 characters')],
                         ids=['d', 'frame_id'])
def test_what_would_be_kept_and_repeated_has_a_limit(info, new, fields, says):
    fields = {k: header(new, 1, v) if k == 'header' else v for k, v in fields.items()}
    check_lengths(info(), 'a')
    with pytest.raises(BadCameraInfo, match=f'plane a: .*{says}'):
        check_lengths(info(**fields), 'a')
