"""Silhouettes: segmentations made upstream, as clean and as rough as they come, against known curves."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome, Prior
from fluoro_shape_ros.geometry.cameras import pixels_per_metre, project
from fluoro_shape_ros.imaging.silhouette import LEVEL, outline, shadow
from fluoro_shape_ros.method.outline import FINE_PX, _end_of
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.metrics import compare, surprise
from fluoro_shape_ros.sim import carm, placement, xray

RADIUS = 1.2e-3                 # m, some 3 px
VIEWS = carm.biplane(arm=carm.CArm(pixel_size_iso=0.4e-3, width=448, height=448))
GRID = np.ogrid[:200, :200]     # rows and columns of a drawing
ELLIPSOID = 7.81                # 95 % of chi-squared with three degrees of freedom


def band(half_width, center=80.0):
    """(200, 200) uint8: a straight device from column 20 to 180."""
    v, u = GRID
    return ((np.abs(v - center) <= half_width) & (u >= 20) & (u < 180)).astype(np.uint8)


def thickness(image):
    """px: root of the second moment across the shadow of a `band`, and where its middle is."""
    dark = (LEVEL - image[:, 60:140]).sum(axis=1)
    rows = np.arange(len(dark))
    middle = (dark * rows).sum() / dark.sum()
    return np.sqrt((dark * (rows - middle)**2).sum() / dark.sum()), middle


@cache
def drawn(seed):
    """The true backbone of a device whose base is outside, or inside where the seed is odd, and what part of each
    pixel's ray it takes, as a share of its diameter."""
    rng = np.random.default_rng(seed)
    fields = tuple(map(placement.Field, VIEWS))
    shape, shaft = placement.place(rng, fields, 'spline', (0.05, 0.09), entering=seed % 2 == 0)
    whole = placement.with_shaft(shape.backbone(), shaft)
    return placement.seen_in_both(whole, fields), [xray.path_length(whole, RADIUS, v) / (2 * RADIUS) for v in VIEWS]


def silhouettes(seed, thicker_px=0, jagged=True):
    """The true backbone, and uint8 masks of 0 and 255 that are so much too thick or thin."""
    truth, lengths = drawn(seed)
    rng = np.random.default_rng([seed, 1])
    pen = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(thicker_px) + 1,) * 2)
    masks = [(cv2.dilate if thicker_px > 0 else cv2.erode)((length > 0.3).astype(np.uint8), pen) for length in lengths]
    return truth, [255 * (rough(mask, rng) if jagged else mask) for mask in masks]


def rough(mask, rng):
    """A mask with bites and bumps of 1 or 2 px at every tenth pixel of its edge, holes in it and islands beside it."""
    inner, outer = mask - cv2.erode(mask, np.ones((3, 3))), cv2.dilate(mask, np.ones((3, 3))) - mask
    for edge, change in ((inner, 0), (outer, 1)):
        for size in (1, 2):
            spots = edge * (rng.random(mask.shape) < 0.05).astype(np.uint8)
            mask = np.where(cv2.dilate(spots, np.ones((size, size))) > 0, np.uint8(change), mask)
    holes, islands = ((rng.random(mask.shape) < share).astype(np.uint8) for share in (0.01, 1e-4))
    return mask * (1 - holes) | cv2.dilate(islands, np.ones((2, 3)))


def answer(truth, masks, radius=RADIUS, prior=Prior(), **parameters):    # noqa: B008 (never changed)
    config = Config.from_values(image_kind='silhouette', robot_radius=radius, base_position=tuple(truth[0]),
                                **parameters)
    return reconstruct(Frame(0, 'here', tuple(masks), VIEWS), config, prior)


def along(result, truth):
    """m by which the tip is found too far out along the device."""
    direction = truth[-1] - truth[-9]
    return float((result.shape.tip - truth[-1]) @ direction / np.linalg.norm(direction))


@pytest.mark.parametrize('of', [lambda m, rng: m, lambda m, rng: 255 * m,
                                lambda m, rng: m * rng.integers(1, 256, m.shape).astype(np.uint8),
                                lambda m, rng: m * rng.integers(1, 2**16, m.shape).astype(np.uint16),
                                lambda m, rng: m.astype(np.float32)])
def test_all_but_zero_is_device(of):
    mask = band(6)
    assert np.array_equal(outline(of(mask, np.random.default_rng(1)), 6.0), mask)


def test_small_holes_are_closed_and_small_islands_are_gone():
    mask = band(6)
    spoiled = mask.copy()
    spoiled[78:82, 50:54] = 0           # 16 px, of a disc of 113
    spoiled[80:87, 100:103] = 0         # a bite stays
    mask[80:87, 100:103] = 0
    spoiled[120:125, 30:50] = 1         # 100 px
    spoiled[140:152, 30:50] = mask[140:152, 30:50] = 1      # 240 px: may be device
    assert np.array_equal(outline(spoiled, 6.0), mask)
    assert not outline(np.zeros_like(mask), 6.0).any() and (shadow(np.zeros_like(mask), 6.0) == LEVEL).all()


@pytest.mark.parametrize('quality', [60, 95])
def test_what_jpeg_leaves_of_a_silhouette(quality):
    mask = outline(silhouettes(1)[1][0], 3.0)
    received = cv2.imdecode(cv2.imencode('.jpg', 255 * mask, [cv2.IMWRITE_JPEG_QUALITY, quality])[1],
                            cv2.IMREAD_UNCHANGED)
    assert np.count_nonzero(received) > 1.3 * np.count_nonzero(mask)        # it rings
    assert np.count_nonzero(outline(received, 3.0) != mask) < 0.03 * np.count_nonzero(mask)


@pytest.mark.parametrize('half_width', [4.0, 5.5, 6.0, 8.0, 9.5])
@pytest.mark.parametrize('center', [80.0, 80.5])
def test_the_shadow_is_as_thick_as_the_device_however_thick_the_outline(half_width, center):
    """A cylinder's chords have the second moment r^2 / 4 about its axis."""
    seen, middle = thickness(shadow(band(half_width, center), 6.0))
    assert seen == pytest.approx(np.hypot(3.0, 0.8), abs=0.3) and middle == pytest.approx(center, abs=0.01)


def test_the_ends_of_outlines():
    """A flat end is a step; that of which the rim is seen goes on as an ellipse, whose area is that of pi / 4 of its
    length."""
    at = lambda shape: (np.arange(len(shape)) - len(shape) // 2) * FINE_PX     # noqa: E731
    flat, half_circle, corners = (_end_of(10.0, *shape) for shape in ((0.0, 0.0), (10.0, 0.0), (0.0, 4.0)))
    assert np.interp([-3, 0, 3], at(flat), flat) == pytest.approx([1.0, 0.5, 0.0], abs=0.1)
    assert (np.interp([0, 5, 8, 11], at(half_circle), half_circle)
            == pytest.approx([1.0, np.sqrt(0.75), 0.6, 0.0], abs=0.05))
    assert half_circle[at(half_circle) >= 0].sum() * FINE_PX == pytest.approx(10 * np.pi / 4, abs=0.2)
    assert (np.interp([0, 2, 2.5, 5.5], at(corners), corners)
            == pytest.approx([1.0, (6 + np.sqrt(12)) / 10, (6 + np.sqrt(9.75)) / 10, 0.0], abs=0.03))


@pytest.mark.parametrize('thicker_px', [-1, 0, 2])
def test_clean_outlines(thicker_px):
    """A pixel is 0.4 mm, and the outlines end two of them too far out, or one too early."""
    for seed in (1, 2, 3):
        truth, masks = silhouettes(seed, thicker_px, jagged=False)
        result = answer(truth, masks)
        assert (result.outcome is Outcome.OK and compare(result.shape.points, truth).mean < 0.06e-3
                and abs(along(result, truth)) < 0.5e-3)


def test_rough_outlines_and_what_the_covariance_says_of_them():
    inside, published, tips = [], 0, []
    for seed in range(1, 13):
        truth, masks = silhouettes(seed, (-1, 0, 1, 2)[seed % 4])
        result = answer(truth, masks, min_confidence=0.5)
        assert result.outcome is Outcome.OK, result.detail
        published += result.confidence >= Config().plausibility.min_confidence
        assert compare(result.shape.points, truth).mean < 0.2e-3
        tips.append(np.linalg.norm(result.shape.tip - truth[-1]))
        inside.append(surprise(result.shape.tip - truth[-1], result.shape.covariance[-1]) < ELLIPSOID)
    assert published >= 9 and np.mean(inside) >= 0.8 and np.median(tips) < 0.5e-3


def test_jagged_outlines_are_known_less_well():
    """In the middle; what the calibration is worth is part of either."""
    def variance(seed, jagged):
        covariance = answer(*silhouettes(seed, jagged=jagged), min_confidence=0.0).shape.covariance
        return np.trace(covariance[len(covariance) // 2])

    assert sum(variance(seed, True) for seed in (1, 2, 3, 4)) > 1.1 * sum(variance(seed, False)
                                                                          for seed in (1, 2, 3, 4))


@pytest.mark.parametrize('share', [0.75, 1.25])
def test_a_radius_that_is_off_by_a_quarter(share):
    truth, masks = silhouettes(3)
    result = answer(truth, masks, share * RADIUS)
    assert (result.outcome is Outcome.OK and compare(result.shape.points, truth).mean < 0.2e-3
            and abs(along(result, truth)) < 0.8e-3)


def test_a_line_drawn_with_a_round_brush_ends_where_the_brush_stopped():
    """20 px wide: the outline goes on for 10 px, 4 mm, past both ends."""
    truth, _ = drawn(3)
    lines = [np.round(16 * project(v.P, truth)).astype(np.int32) for v in VIEWS]
    masks = [cv2.polylines(np.zeros((v.height, v.width), np.uint8), [line], False, 255, 21, cv2.LINE_8, 4)
             for v, line in zip(VIEWS, lines)]
    result = answer(truth, masks, 10 / pixels_per_metre(VIEWS[0].P, truth))
    assert result.outcome is Outcome.OK and compare(result.shape.points, truth).mean < 0.1e-3
    assert abs(along(result, truth)) < 0.6e-3 and np.linalg.norm(result.shape.points[0] - truth[0]) < 0.8e-3


def test_levels_polarity_and_a_mask_image_change_nothing():
    truth, masks = silhouettes(2)
    first = answer(truth, masks)
    seen = [255 - m for m in masks]
    for other in (answer(truth, [m // 255 for m in masks]), answer(truth, [257 * m.astype(np.uint16) for m in masks]),
                  answer(truth, masks, polarity='bright'),
                  answer(truth, masks, prior=Prior(masks=tuple(m.astype(np.float32) for m in seen)))):
        assert np.array_equal(other.shape.points, first.shape.points) and other.confidence == first.confidence


def test_a_device_is_tracked_and_nothing_is_no_device():
    truth, masks = silhouettes(1, jagged=False)        # rough ends lie elsewhere on strips that are laid out otherwise
    first = answer(truth, masks)
    again = answer(truth, masks, prior=Prior(previous=first.shape, previous_stamp_ns=0))
    assert 'search' not in again.stage_seconds and np.linalg.norm(again.shape.tip - first.shape.tip) < 0.2e-3
    assert answer(truth, [np.zeros_like(m) for m in masks]).outcome is Outcome.NO_DEVICE_A
    assert answer(truth, [masks[0], np.zeros_like(masks[1])]).outcome is Outcome.NO_DEVICE_B


def test_the_published_method_takes_them_too():
    truth, masks = silhouettes(3)
    result = answer(truth, masks, method='paper', max_curvature=1e4)
    assert result.outcome is Outcome.OK and compare(result.shape.points, truth).mean < 1e-3


def test_images_are_xray_by_default():
    truth, masks = silhouettes(3)
    config = Config.from_values(robot_radius=RADIUS, base_position=tuple(truth[0]))
    result = reconstruct(Frame(0, 'here', tuple(255 - m for m in masks), VIEWS), config)
    assert replace(result, stage_seconds={}).confidence != answer(truth, masks).confidence


def test_the_node_answers_as_the_replay_does_and_changes_its_mind_at_run_time(tmp_path):
    pytest.importorskip('rclpy')
    pytest.importorskip('rosbags')
    import ros_client as ros
    from recording import read, record

    masks = [(pixels < 140).astype(np.uint8) for pixels in ros.GOOD]
    record(tmp_path / 'run', [masks])
    given = 'image_kind:=silhouette', 'tracking:=false', ros.BASE, ros.RADIUS
    replay = [sys.executable, '-m', 'fluoro_shape_ros.files.replay', 'run', '--out', 'out',
              *(word for p in given for word in ('-p', p))]
    assert subprocess.run(replay, cwd=tmp_path, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
                          timeout=60).returncode == 0
    (_, offline), = read(tmp_path / 'out')['/backbone']
    for transport in ('raw', 'compressed'):
        start = *given, f'image_transport:={transport}', 'time_budget:=0'
        with (ros.NodeProcess(tmp_path / f'{transport}.txt', *start, domain=ros.OTHER) as node,
              ros.Client(compressed=transport == 'compressed', domain=ros.OTHER) as client):
            assert client.connected() and client.insist(lambda: client.paths, pair=masks, every=1.0), node.log
            assert np.array_equal(ros.points(client.paths[max(client.paths)]), ros.points(offline))
            answered = client.set('image_kind', 'mri')
            assert (not answered.successful and 'must be one of xray, silhouette' in answered.reason
                    and client.get('image_kind') == ['silhouette'])
            assert client.set('image_kind', 'xray').successful
            refused = lambda: any(s.name.endswith('reconstruction') and 'no_device' in s.message    # noqa: E731
                                  for s in client.statuses)
            assert client.insist(refused, pair=[0 * m for m in masks])
            client.paths.clear()
            assert client.insist(lambda: client.paths, every=1.0), node.log     # X-ray images again
            assert node.end() == 0 and 'Traceback' not in node.log
