"""The whole way from a pair of images to a backbone, on small X-ray scenes with known truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Distortion, Frame, Outcome, Prior, Shape
from fluoro_shape_ros.geometry.cameras import calibration_covariance, decompose, make_view, undistort
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.strips import Sheet
from fluoro_shape_ros.method.backbone import backbone
from fluoro_shape_ros.method.fit.fit import fit
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.xray import Exposure

SIZE = 512
VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=SIZE, height=SIZE))
RUN = dict(views=VIEWS, lengths=(0.06, 0.07))
SAME = 0.02e-3          # m: what only the order of arithmetic may change
# 0.1 px: OpenCV 4 rounds the places that it samples to 1/32 px, otherwise for a fit that began elsewhere
ROUNDING = 0.03e-3
NOISE = 0.2e-3          # m: three standard deviations of an end, for what samples other pixels


@pytest.fixture(scope='module')
def run():
    return xray_run(0, anatomy=False, **RUN)


@pytest.fixture(scope='module')
def scene(run):
    return run.scene()


@pytest.fixture(scope='module')
def blank(run):
    return run.without_device()


@pytest.fixture(scope='module')
def config(scene):
    return Config.from_values(base_position=scene.base_position.tolist())


@pytest.fixture(scope='module')
def answer(scene, config):
    return reconstruct(scene.frame, config)


def test_what_a_fit_leaves_over_counts_like_a_calibration_error(scene):
    sheet = Sheet.of([np.sqrt(i, dtype=np.float32) for i in scene.frame.images],
                     [field_of_view(i) for i in scene.frame.images], VIEWS)
    f = fit(sheet, scene.truth, scene.radius)
    even = replace(f, offset_px=np.zeros_like(f.offset_px))
    beside = replace(even, offset_px=even.offset_px + (f.s > f.stop - 20 * (f.s[1] - f.s[0]))[:, None] * [0.0, 0.8])
    plain, more = (backbone(x, VIEWS, True, 1e-3) for x in (even, beside))
    tangent = f.spline(np.array([f.stop]), 1)
    assert_allclose((more.covariance - plain.covariance)[-1],
                    calibration_covariance(VIEWS, plain.points[-1:], tangent, 0.8)[0], rtol=1e-6, atol=1e-16)
    assert_allclose(more.covariance[0], plain.covariance[0])
    # one strip in five is noise, or hidden
    alone = replace(even, offset_px=np.where(np.arange(len(f.s)) % 5 == 0, 2.0, 0.0)[:, None] * [1.0, 1.0])
    assert_allclose(backbone(alone, VIEWS, True, 1e-3).covariance, plain.covariance)
    unknown = replace(even, offset_px=np.full_like(f.offset_px, np.nan))
    assert_allclose(backbone(unknown, VIEWS, True, 1e-3).covariance, plain.covariance)


def off(points, curve):
    """(N,) m from (N, 3) points to a curve, to 5 um."""
    return cKDTree(at_arc_length(curve, np.arange(0, arc_length(curve)[-1], 5e-6))).query(points)[0]


def mapped(frame, change):
    return replace(frame, images=tuple(change(i) for i in frame.images))


def assert_same(result, answer, within=SAME, ends=SAME):
    """Both are the same backbone, base to tip: to `within` m along it, its ends to `ends` m."""
    assert result.outcome is Outcome.OK, result.detail
    assert np.linalg.norm(result.shape.points[[0, -1]] - answer.shape.points[[0, -1]], axis=1).max() < ends
    inner = result.shape.points[3:-3]
    assert off(inner, answer.shape.points).max() < within


def test_the_answer_is_the_device(scene, answer):
    assert answer.outcome is Outcome.OK and not answer.warnings
    assert off(answer.shape.points, scene.truth).mean() < 0.03e-3
    assert np.linalg.norm(answer.shape.tip - scene.truth[-1]) < 0.15e-3
    assert abs(answer.shape.length - arc_length(scene.truth)[-1]) < 0.2e-3


def test_equal_steps_and_the_tip_last(scene, config, answer):
    for step in (0.001, 0.0025):
        shape = reconstruct(scene.frame, config.replace(backbone_spacing=step)).shape
        steps = np.diff(shape.s)
        assert_allclose(steps[:-1], step, rtol=1e-9)
        assert 0 < steps[-1] <= step * (1 + 1e-9) and shape.s[0] == 0
        # a chord is shorter than its arc
        assert_allclose(np.linalg.norm(np.diff(shape.points, axis=0), axis=1), steps, rtol=2e-3)
        assert_allclose(shape.tip, answer.shape.tip, atol=1e-6)


def test_what_comes_with_each_point(answer):
    shape, n = answer.shape, len(answer.shape.points)
    assert shape.covariance.shape == (n, 3, 3) and shape.residuals_px.shape == (n, 2)
    sigma = np.sqrt(np.linalg.eigvalsh(shape.covariance))
    assert (sigma > 1e-6).all() and (sigma < 0.3e-3).all()
    assert sigma[-1, -1] > sigma[n // 2, -2]                # an end is known less well than the middle across
    assert np.isfinite(shape.residuals_px).mean() > 0.9 and np.nanmedian(shape.residuals_px) < 0.3
    assert answer.centerlines[0] is not None and answer.centerlines[1] is not None
    assert answer.stage_seconds and min(answer.stage_seconds.values()) >= 0


def test_the_same_pair_gives_the_same_answer(scene, config, answer):
    again = reconstruct(scene.frame, config)
    assert ((again.shape.points == answer.shape.points).all()
            and (again.shape.covariance == answer.shape.covariance).all())


@pytest.mark.parametrize('polarity', ['bright', 'auto'])
def test_a_bright_device_is_a_dark_one_inverted(scene, config, answer, polarity):
    inverted = mapped(scene.frame, lambda i: 255 - i)
    assert_same(reconstruct(inverted, config.replace(polarity=polarity)), answer, within=0.03e-3, ends=NOISE)
    assert reconstruct(inverted, config).outcome is not Outcome.OK


def test_auto_takes_a_dark_device_as_dark(scene, config, answer):
    assert_same(reconstruct(scene.frame, config.replace(polarity='auto')), answer)


@pytest.mark.parametrize('change', [lambda i: i.astype(np.uint16) * 257, lambda i: i.astype('>u2') * 16,
                                    lambda i: i.astype(np.float32) / 255],
                         ids=['mono16', 'big endian', '32FC1'])
def test_depth_and_range_of_the_image_do_not_matter(scene, config, answer, change):
    assert_same(reconstruct(mapped(scene.frame, change), config), answer)


def shown(image, display):
    """The same X-rays on another display, 16 bits."""
    share = image / image.max()
    return np.round({'gamma 0.5': share**0.5, 'gamma 2': share**2,
                     'logarithm': np.log1p(200 * share) / np.log(201)}[display] * 65535).astype(np.uint16)


@pytest.mark.parametrize('planes', [(0,), (1,), (0, 1)])
@pytest.mark.parametrize('display', ['gamma 0.5', 'gamma 2', 'logarithm'])
def test_what_a_display_does_to_the_counts_does_not_matter(scene, config, answer, display, planes):
    frame = replace(scene.frame, images=tuple(shown(i, display) if k in planes else i
                                              for k, i in enumerate(scene.frame.images)))
    other = reconstruct(frame, config)
    assert_allclose(other.confidence, answer.confidence, atol=0.01)
    # how opaque an end looks is not freed of the display yet
    assert_allclose(other.shape.points[[0, -1]], answer.shape.points[[0, -1]], atol=NOISE)
    assert cKDTree(answer.shape.points).query(other.shape.points[1:-1])[0].max() < 0.03e-3       # 0.1 px


def test_a_float_image_may_be_negative(scene, config, answer):
    shifted = mapped(scene.frame, lambda i: i.astype(np.float32) - 300)
    # without a true zero the darkness of the device is not known
    assert_same(reconstruct(shifted, config), answer, within=0.05e-3, ends=0.7e-3)


def test_swapped_planes_give_the_same_curve(scene, config, answer):
    a, b = scene.frame.views
    swapped = replace(scene.frame, images=scene.frame.images[::-1], views=(replace(b, name='a'), replace(a, name='b')))
    assert_same(reconstruct(swapped, config), answer)


def test_a_mirrored_plane_gives_the_same_curve(scene, config, answer):
    a, b = scene.frame.views
    flip = np.array([[-1, 0, SIZE - 1], [0, 1, 0], [0, 0, 1.0]])
    mirrored = replace(scene.frame, images=(scene.frame.images[0][:, ::-1].copy(), scene.frame.images[1]),
                       views=(replace(a, P=flip @ a.P), b))
    assert_same(reconstruct(mirrored, config), answer, ends=NOISE)


def test_the_reference_frame_is_free(scene, config, answer):
    R, t = Rotation.from_euler('xyz', [0.4, -1.1, 2.0]).as_matrix(), np.array([1.0, -2.0, 0.5])
    old_from_new = np.r_[np.c_[R.T, -R.T @ t], [[0, 0, 0, 1]]]
    moved = replace(scene.frame, views=tuple(replace(v, P=v.P @ old_from_new) for v in scene.frame.views))
    result = reconstruct(moved, config.replace(base_position=(R @ scene.base_position + t).tolist()))
    assert result.outcome is Outcome.OK
    assert off((result.shape.points - t) @ R, answer.shape.points).max() < SAME


@pytest.fixture(scope='module')
def distorted(scene):
    """The pair as a barrel and a tilted intensifier would show it, some px away at the border."""
    tilted = np.array([-2.0, 1.0, 0.01, -0.02, 0])
    views, images = [], []
    for view, image in zip(scene.frame.views, scene.frame.images):
        K, _, _ = decompose(view.P)
        view = replace(view, distortion=Distortion('plumb_bob', K + [[0, 0, 2.0], [0, 0, -3.0], [0, 0, 0]], tilted,
                                                   np.eye(3)))
        coarse = np.arange(0, SIZE + 8.0, 8)
        uv = np.stack(np.meshgrid(coarse, coarse), axis=-1)
        ideal = undistort(view, uv.reshape(-1, 2)).reshape(uv.shape).astype(np.float32)
        v, u = (np.mgrid[0:SIZE, 0:SIZE] / 8).astype(np.float32)
        ideal = cv2.remap(ideal, u, v, cv2.INTER_CUBIC)             # smooth: every eighth pixel says all
        images.append(cv2.remap(image, ideal, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        views.append(view)
    return replace(scene.frame, images=tuple(images), views=tuple(views))


def test_distortion_is_removed(scene, distorted, config, answer):
    assert_same(reconstruct(distorted, config), answer, within=0.04e-3, ends=NOISE)
    assert_same(reconstruct(distorted, config, Prior(previous=answer.shape)), answer, within=0.04e-3, ends=NOISE)
    ignored = reconstruct(replace(distorted, views=scene.frame.views), config)
    assert ignored.shape is None or off(ignored.shape.points, answer.shape.points).mean() > 0.3e-3


def test_a_pair_without_device_is_rejected(blank, config):
    assert reconstruct(blank, config).outcome in (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)


@pytest.mark.parametrize('value, dtype', [(0, np.uint8), (3, np.uint8), (128, np.uint8), (255, np.uint8),
                                          (40000, np.uint16), (0.7, np.float32)])
@pytest.mark.parametrize('shape', [(512, 512), (300, 300)])
def test_an_even_pair_is_no_device(config, shape, value, dtype):
    views = biplane(arm=CArm(width=shape[1], height=shape[0]))
    assert reconstruct(Frame(0, '', (np.full(shape, value, dtype),) * 2, views), config).outcome is Outcome.NO_DEVICE_A


@pytest.mark.parametrize('anatomy', [False, True])
@pytest.mark.parametrize('seed', [0, 1])
@pytest.mark.parametrize('plane', [0, 1])
def test_a_device_in_one_plane_only_is_rejected(plane, seed, anatomy):
    run = xray_run(seed, anatomy=anatomy, **RUN)
    there, gone = run.scene().frame, run.without_device()
    images = (there.images[0], gone.images[1]) if plane == 0 else (gone.images[0], there.images[1])
    result = reconstruct(replace(there, images=images), Config())
    assert result.outcome is not Outcome.OK and result.detail
    if not anatomy:
        assert result.outcome is (Outcome.NO_DEVICE_B, Outcome.NO_DEVICE_A)[plane]


def test_planes_of_different_moments_are_rejected(scene, config):
    other = xray_run(7, anatomy=False, **RUN).scene()
    assert (reconstruct(replace(scene.frame, images=(scene.frame.images[0], other.frame.images[1])), config).outcome
            is not Outcome.OK)


def test_parallel_planes_are_no_geometry(scene, config):
    same = replace(scene.frame, views=(VIEWS[0], VIEWS[0]))
    assert reconstruct(same, config).outcome is Outcome.BAD_GEOMETRY


@pytest.mark.parametrize('method', ['spline', 'paper'])
def test_a_rectified_stereo_pair_in_the_frame_of_plane_a(method):
    K, R, t = decompose(VIEWS[0].P)
    baseline = 0.06
    views = tuple(make_view(name, K @ np.c_[R, t + [x, 0, 0]], SIZE, SIZE)
                  for name, x in (('a', baseline / 2), ('b', -baseline / 2)))
    seen = xray_run(0, anatomy=False, **RUN | dict(views=views)).scene()
    rectified = tuple(make_view(name, K @ np.c_[np.eye(3), [x, 0, 0]], SIZE, SIZE)
                      for name, x in (('a', 0), ('b', -baseline)))
    result = reconstruct(replace(seen.frame, views=rectified), Config.from_values(method=method))
    assert result.outcome is Outcome.OK
    truth = seen.truth @ R.T + t + [baseline / 2, 0, 0]
    assert np.median(off(result.shape.points, truth)) < {'spline': 0.001, 'paper': 0.004}[method]


def reversed_shape(shape):
    return replace(shape, points=shape.points[::-1])


@pytest.mark.parametrize('base_is_first', [True, False])
def test_the_base_position_decides_the_end(scene, answer, base_is_first):
    base = scene.truth[0 if base_is_first else -1]
    result = reconstruct(scene.frame, Config.from_values(base_position=base.tolist()))
    assert not result.warnings
    assert_allclose(result.shape.points[0], base, atol=0.2e-3)
    assert_allclose(result.shape.tip, scene.truth[-1 if base_is_first else 0], atol=0.2e-3)


@pytest.mark.parametrize('tracking', [True, False])
@pytest.mark.parametrize('turned', [False, True])
def test_else_the_previous_result_decides(scene, answer, turned, tracking):
    previous = reversed_shape(answer.shape) if turned else answer.shape
    result = reconstruct(scene.frame, Config.from_values(tracking=tracking), Prior(previous=previous))
    assert not result.warnings
    assert np.linalg.norm(result.shape.tip - previous.tip) < 0.1e-3


def test_else_it_is_a_guess_and_said_to_be_one(scene):
    result = reconstruct(scene.frame, Config())
    assert result.outcome is Outcome.OK and result.warnings == ('tip_ambiguous',)


def test_a_device_that_enters_the_field_ends_inside_it():
    scene = xray_run(3, views=VIEWS, lengths=(0.05, 0.06), anatomy=False, entering=True).scene()
    wrong = Config.from_values(base_position=scene.truth[-1].tolist())          # the border knows better
    for config in (Config(), wrong):
        result = reconstruct(scene.frame, config)
        assert result.outcome is Outcome.OK and not result.warnings
        assert np.linalg.norm(result.shape.tip - scene.truth[-1]) < 0.2e-3
        assert off(result.shape.points, scene.truth).mean() < 0.1e-3


def cut_short(shape, lost, end):
    """`shape` as it was when it ended `lost` m earlier at one end."""
    keep = shape.s >= lost if end == 'base' else shape.s <= shape.length - lost
    return Shape(shape.points[keep], shape.s[keep] - shape.s[keep][0], shape.covariance[keep], shape.residuals_px[keep])


def test_tracking_changes_nothing(scene, config, answer):
    previous = replace(answer.shape, points=answer.shape.points + [0.4e-3, -0.4e-3, 0.4e-3])
    for prior in (Prior(previous=answer.shape), Prior(previous=previous)):
        assert_same(reconstruct(scene.frame, config, prior), answer, ends=ROUNDING)
        assert_same(reconstruct(scene.frame, config.replace(tracking=False), prior), answer)


@pytest.mark.parametrize('lost', [0.003, 0.008, 0.012, 0.030])
@pytest.mark.parametrize('end', ['tip', 'base'])
def test_tracking_follows_a_device_that_has_advanced(scene, config, answer, end, lost):
    result = reconstruct(scene.frame, config, Prior(previous=cut_short(answer.shape, lost, end)))
    assert_same(result, answer, within=0.05e-3, ends=NOISE)


def test_tracking_follows_a_device_that_has_drawn_back(run, config):
    long, short = run.scene(0.0), run.scene(1.5)
    assert arc_length(long.truth)[-1] - arc_length(short.truth)[-1] > 0.003
    before = reconstruct(long.frame, config)
    result = reconstruct(short.frame, config, Prior(previous=before.shape))
    assert result.outcome is Outcome.OK
    assert (np.linalg.norm(result.shape.tip - short.truth[-1]) < 0.2e-3
            and off(result.shape.points, short.truth).mean() < 0.05e-3)


@pytest.mark.parametrize('away', [(0.012, 0, 0), (0.0, 0.0, 0.03), (0.1, 0.1, 0.1)])
def test_a_previous_result_elsewhere_does_no_harm(scene, config, answer, away):
    previous = replace(answer.shape, points=answer.shape.points + away)
    assert_same(reconstruct(scene.frame, config, Prior(previous=previous)), answer)


def test_a_device_that_is_gone_is_not_tracked_on(scene, blank, config, answer):
    prior = Prior(previous=answer.shape)
    assert reconstruct(blank, config, prior).outcome is Outcome.NO_DEVICE_A
    half = replace(scene.frame, images=(scene.frame.images[0], blank.images[1]))
    assert reconstruct(half, config, prior).outcome is Outcome.NO_DEVICE_B


@pytest.mark.parametrize('values, outcome', [
    (dict(max_tip_sigma=1e-5), Outcome.TIP_UNCERTAIN),
    (dict(expected_length=(0.1, 0.2)), Outcome.LENGTH),
    (dict(expected_length=(0.01, 0.05)), Outcome.LENGTH),
    (dict(max_curvature=5.0), Outcome.CURVATURE),
    (dict(min_confidence=1.0), Outcome.LOW_CONFIDENCE),
    (dict(min_length_px=400.0), Outcome.NO_DEVICE_A),
])
def test_doubts_reject_by_name(scene, config, values, outcome):
    result = reconstruct(scene.frame, config.replace(**values))
    assert result.outcome is outcome and result.detail


def test_confidence_is_a_probability_that_decides_and_changes_nothing(scene, config, answer):
    assert 0 < answer.confidence < 1
    refused, published = (reconstruct(scene.frame, config.replace(min_confidence=c)) for c in (1.0, 0.0))
    assert published.confidence == pytest.approx(answer.confidence) and 0 < refused.confidence < 1
    assert_same(published, answer)
    assert refused.outcome is Outcome.LOW_CONFIDENCE and refused.shape is None and None not in refused.centerlines


@pytest.mark.parametrize('seed', [0, 1, 3])
@pytest.mark.parametrize('contrast', [0.25, 0.9])
@pytest.mark.parametrize('wider', [0.5, 1.9])
def test_a_robot_radius_that_is_far_off_is_borne_or_named(seed, contrast, wider):
    scene = xray_run(seed, anatomy=False, exposure=Exposure(contrast=contrast), **RUN).scene()
    result = reconstruct(scene.frame, Config.from_values(robot_radius=scene.radius / wider,
                                                         base_position=scene.base_position.tolist()))
    if result.outcome is Outcome.OK:
        assert (off(result.shape.points, scene.truth).mean() < 0.05e-3
                and np.linalg.norm(result.shape.tip - scene.truth[-1]) < 1e-3)
    else:
        assert result.outcome is Outcome.LOW_CONFIDENCE and result.detail


PAST, NEVER = 0.0, 1e12     # time.monotonic(): time is up from the beginning, or never


def test_a_search_that_is_cut_short_is_out_of_time(scene, config):
    result = reconstruct(scene.frame, config, until=PAST)
    assert (result.outcome is Outcome.OUT_OF_TIME and result.detail == 'no curve was found by then'
            and result.shape is None)


def test_what_was_found_by_then_is_judged(scene, config, answer):
    prior = Prior(previous=answer.shape)
    result = reconstruct(scene.frame, config.replace(min_confidence=1.0), prior, PAST)
    assert (result.outcome is Outcome.OUT_OF_TIME and 'by then: ' in result.detail and 0.5 < result.confidence < 1
            and None not in result.centerlines)
    assert_same(reconstruct(scene.frame, config.replace(min_confidence=0.5), prior, PAST), answer, ends=ROUNDING)
    # no more time would have helped
    assert reconstruct(scene.frame, config.replace(expected_length=(0.1, 0.2)), prior, PAST).outcome is Outcome.LENGTH


def test_a_search_that_is_cut_short_goes_on_with_the_next_pair(scene, config, answer):
    prior, turns = Prior(), 0
    while not (result := reconstruct(scene.frame, config, prior, until=0.0)).shape:
        assert result.outcome is Outcome.OUT_OF_TIME and result.search is not None
        prior, turns = Prior(search=result.search), turns + 1
        assert turns < 50
    assert turns >= 2 and result.search is None
    assert cKDTree(answer.shape.points).query(result.shape.points)[0].max() < ROUNDING


def test_the_device_is_looked_for_where_it_was_however_late_it_is(scene, config, answer):
    prior = Prior(previous=answer.shape)
    given = reconstruct(scene.frame, config, prior, PAST)
    assert (given.outcome is Outcome.OK
            and (given.shape.points == reconstruct(scene.frame, config, prior).shape.points).all())


def test_a_search_that_ends_in_time_is_as_without_a_limit(scene, blank, config, answer):
    given = reconstruct(scene.frame, config, until=NEVER)
    assert (given.shape.points == answer.shape.points).all() and given.confidence == answer.confidence
    assert reconstruct(blank, config, until=NEVER).outcome is Outcome.NO_DEVICE_A


def test_the_published_method_has_no_limit(scene, config):
    given = config.replace(method='paper')
    assert (reconstruct(scene.frame, given, until=PAST).outcome is reconstruct(scene.frame, given).outcome
            is not Outcome.OUT_OF_TIME)


def test_limits_that_are_kept_reject_nothing(scene, config, answer):
    kept = config.replace(max_tip_sigma=0.001, expected_length=(0.05, 0.08), max_curvature=60.0, min_length_px=150.0,
                          max_reprojection_px=0.5)
    assert_same(reconstruct(scene.frame, kept), answer)
