"""Subtraction of a device-free mask: what stands still or shifts a little goes, the device stays."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Prior
from fluoro_shape_ros.imaging.mask import shift_between, subtract
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.sim.anatomy import anatomy
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.xray import Exposure

SIZE = (512, 512)
VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
LEVEL = 200.0
NOISE = 0.010           # of a pixel at LEVEL, as a share of it


def background(shift=(0.0, 0.0), size=SIZE):
    """(H, W) float32 counts of an anatomy that has moved by u, v px."""
    still = LEVEL * anatomy(np.random.default_rng(5), size).astype(np.float32)
    moved = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    return cv2.warpAffine(still, moved, size[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def noisy(counts, seed):
    rng = np.random.default_rng(seed)
    return (counts + NOISE * np.sqrt(counts * LEVEL) * rng.standard_normal(counts.shape, np.float32)).astype(np.float32)


@pytest.fixture(scope='module')
def mask():
    return np.mean([noisy(background(), seed) for seed in range(8)], axis=0)


@pytest.mark.parametrize('shift', [(0.0, 0.0), (0.4, -0.7), (3.3, 2.6), (-7.25, 5.5)])
def test_a_shifted_background_is_gone_down_to_the_noise(mask, shift):
    live = background(shift)
    left = subtract(noisy(live, 100), mask)[20:-20, 20:-20]
    assert live[20:-20, 20:-20].std() / live.mean() > 0.15
    noise = ((NOISE * np.sqrt(LEVEL / live[20:-20, 20:-20])).std()**2
             + np.mean(NOISE**2 * LEVEL / live[20:-20, 20:-20]) * (1 + 1 / 8))
    assert left.std() / left.mean() < 1.15 * np.sqrt(noise)
    assert_allclose(left.mean(), mask.mean(), rtol=0.02)


@pytest.mark.parametrize('size', [(512, 512), (480, 640), (300, 320), (968, 968)])
def test_what_has_not_moved_has_not_moved(size):
    still = background(size=size)
    assert_allclose(shift_between(still, still), 0, atol=0.1)


def test_the_shift_has_the_sign_of_the_scenes_motion(mask):
    assert_allclose(shift_between(mask, noisy(background((6.0, -4.0)), 100)), (6.0, -4.0), atol=0.7)


def test_what_cannot_be_a_shift_is_none(mask):
    other = LEVEL * anatomy(np.random.default_rng(9), SIZE).astype(np.float32)
    for image in (other, np.full(SIZE, 100, np.float32), background((30, 0))):
        assert shift_between(mask, image) == (0.0, 0.0)


def test_the_device_stays_as_the_share_of_the_beam_it_lets_through():
    counts = background()
    live = counts.copy()
    live[200:260, 250:255] *= 0.7           # in front of bright and dark anatomy alike
    left = subtract(live, counts) / counts.mean()
    assert_allclose(left[200:260, 250:255], 0.7, atol=0.02)
    assert_allclose(left[:190], 1, atol=0.02)


def test_exposure_that_drifts_is_a_factor():
    counts = background()
    left = subtract(0.8 * counts, counts)
    assert left.std() / left.mean() < 0.005
    assert_allclose(left.mean() / counts.mean(), 0.8, atol=0.01)


def test_blades_make_no_structure():
    counts = background()
    counts[:, :80] = 0
    left = subtract(counts, counts)
    assert np.isfinite(left).all() and np.ptp(left) < 1e-3 * left.mean()


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.float32])
def test_any_depth_of_image_will_do(dtype):
    counts = np.rint(background()).astype(dtype)
    left = subtract(counts, counts.astype(np.float32))
    assert left.dtype == np.float32 and left.std() < 1e-3 * left.mean()


def fluoroscopy(seed):
    """A run with a faint device, and the masks taken before it comes in."""
    run = xray_run(seed, views=VIEWS, lengths=(0.06, 0.07), exposure=Exposure(contrast=0.12))
    frames = [run.without_device(index=k) for k in range(8, 16)]
    return run, [np.mean([f.images[i].astype(np.float32) for f in frames], axis=0) for i in (0, 1)]


@pytest.mark.parametrize('seed', [1, 3])
@pytest.mark.parametrize('shift', [(0.0, 0.0), (2.3, -1.6)])
def test_the_pipeline_sees_a_faint_device_through_its_masks(seed, shift):
    run, masks = fluoroscopy(seed)
    scene, move = run.scene(), np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    masks = tuple(cv2.warpAffine(m, move, SIZE[::-1], borderMode=cv2.BORDER_REPLICATE) for m in masks)
    result = reconstruct(scene.frame, Config.from_values(base_position=scene.base_position.tolist()),
                         Prior(masks=masks))
    assert result.outcome is Outcome.OK, result.detail
    assert cKDTree(scene.truth).query(result.shape.points)[0].mean() < 0.1e-3
    assert np.linalg.norm(result.shape.tip - scene.truth[-1]) < 0.4e-3


def test_an_empty_field_behind_its_mask_shows_no_device():
    run, masks = fluoroscopy(1)
    assert reconstruct(run.without_device(), Config(), Prior(masks=tuple(masks))).outcome in (Outcome.NO_DEVICE_A,
                                                                                              Outcome.NO_DEVICE_B)
