"""Runs from the wide world: what is promised of each draw, and that displays and devices show what they should."""

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fluoro_shape_ros.device import presets
from fluoro_shape_ros.geometry.cameras import pixels_per_metre, plane_angle, project
from fluoro_shape_ros.geometry.curve import arc_length
from fluoro_shape_ros.sim import carm, ct, imaging, scenes, variety

SMALL = carm.biplane(arm=carm.CArm(pixel_size_iso=0.6e-3, width=320, height=320))


@pytest.fixture(scope='module')
def wide():
    return [variety.wide_run(seed) for seed in range(8)]


def test_geometry_is_drawn_from_its_ranges(wide):
    for run in wide:
        views = [f.view for f in run.fields]
        assert variety.BETWEEN[0] - 0.6 < plane_angle(views) < variety.BETWEEN[1] + 0.6   # secondary angles come on top
        sizes = [1 / pixels_per_metre(v.P, np.zeros((1, 3))) for v in views]
        assert 0.9 * variety.PIXELS[0] < min(sizes) and max(sizes) < 1.15 * variety.PIXELS[1] and sizes[0] != sizes[1]
        assert variety.RADII[0] <= run.radius <= variety.RADII[1]
    assert len({run.radius for run in wide}) == len(wide)


def test_planes_are_drawn_unequal_and_the_same_seed_is_the_same(wide):
    again = variety.wide_run(3)
    assert again.chains == wide[3].chains and again.chains[0].imaging != again.chains[1].imaging
    for image, other in zip(again.scene().frame.images, wide[3].scene().frame.images):
        assert_array_equal(image, other)


def test_what_is_drawn_can_be_seen(wide):
    for run in wide:
        signal, darker = variety.visibility(run)
        assert signal >= variety.VISIBLE and darker >= variety.DARKER


def test_visibility_grows_with_the_dose_as_its_root(wide):
    run = wide[0]
    more = dataclasses.replace(run, chains=tuple(dataclasses.replace(c, imaging=dataclasses.replace(
        c.imaging, photons=4 * c.imaging.photons)) for c in run.chains))
    signal, darker = variety.visibility(run)
    assert_allclose(variety.visibility(more), [2 * signal, darker], rtol=1e-5)


def test_truth_lies_on_the_darkest_ridge(wide):
    """Seen without noise: at the true axis the display is darker than three radii beside it."""
    for run in wide:
        truth = run.scene().truth
        for i, chain in enumerate(run.chains):
            shown = imaging.show(imaging.detect(run.sharp(run.backbone(), i),
                                                dataclasses.replace(chain.imaging, bits=16), chain.levels, None),
                                 dataclasses.replace(chain.imaging, bits=16, sharpening=0.0),
                                 chain.levels).astype(float)
            uv = project(run.fields[i].view.P, truth)[20:-20:20]
            along = np.gradient(uv, axis=0)
            across = np.c_[-along[:, 1], along[:, 0]] / np.linalg.norm(along, axis=1, keepdims=True)
            aside = 3 * run.radius * pixels_per_metre(run.fields[i].view.P, truth) + 3 * chain.imaging.blur_px
            on, off = (cv2.remap(shown.astype(np.float32), *(uv + d * across).astype(np.float32).T[:, :, None],
                                 cv2.INTER_LINEAR) for d in (0.0, aside))
            assert (on < off).mean() > 0.9


def test_presets_come_in_turn_and_say_what_they_are():
    for seed in (0, len(presets()) + 1):
        run = variety.device_run(seed)
        assert run.name == presets()[seed % len(presets())]
        assert run.radius == run.device.radius and run.beams is not None


@pytest.fixture(scope='module')
def phantom():
    """A water cylinder of 160 mm with a rod of bone, as coarse as a CT."""
    z, y, x = np.mgrid[:40, :90, :90]
    hu = np.where((x - 45)**2 + (y - 45)**2 < 40**2, 0, -1000).astype(np.int16)
    hu[(x - 30)**2 + (y - 45)**2 < 16] = 1200
    return ct.Volume(hu, np.array([0.005, 0.002, 0.002]))


def test_in_a_ct_every_second_device_enters(phantom):
    kinds = len(presets())
    inside, entering = (variety.ct_run(seed, phantom, 'rod') for seed in (0, kinds))
    assert inside.shaft == 0 < entering.shaft
    for run in (inside, entering):
        for beam in run.beams:
            assert beam.std() > 0.02 and beam.max() <= 1 + 1e-5
        assert all(1 / pixels_per_metre(f.view.P, np.zeros((1, 3))) < 0.3e-3 for f in run.fields)


def test_lag_drags_a_ghost_and_without_it_nothing_changes():
    chain = dataclasses.replace(imaging.SETTINGS['cine'], lag=0.5, photons=1e6, sharpening=0.0)
    run = scenes.xray_run(2, views=SMALL, lengths=(0.067, 0.1), anatomy=False, radius=0.002, chains=(chain, chain))
    averaged = list(scenes.moving(run, 0.5, 2))
    assert_allclose(averaged[1].truth[-1], run.scene(2.0).truth[-1])
    first, second = (run.detected(run.backbone(t), k) for k, t in enumerate((0.0, 2.0)))
    by_hand = run.shown(tuple(0.5 * a + 0.5 * b for a, b in zip(first, second)))
    for image, expected, now in zip(averaged[1].frame.images, by_hand.images, run.scene(2.0, 1).frame.images):
        assert np.abs(image.astype(int) - expected).max() <= 1
        # the noise is one level; where the device was, half of it is left
        assert (image < now.astype(int) - 6).sum() > 20
    sharp = scenes.xray_run(2, views=SMALL, lengths=(0.067, 0.1), anatomy=False, radius=0.002,
                            chains=(dataclasses.replace(chain, lag=0.0),) * 2)
    assert_array_equal(next(scenes.moving(sharp, 2.0, 1)).frame.images[0], sharp.scene().frame.images[0])


def test_device_alone_means_fluoroscopy_and_a_rod_is_that_of_the_exposure():
    run = scenes.xray_run(1, views=SMALL, lengths=(0.067, 0.1), anatomy=False, radius=0.001,
                          chains=(imaging.SETTINGS['cine'],) * 2)
    # at REFERENCE_KEV the rod takes away a quarter where the beam crosses its axis
    assert_allclose(1 - np.exp(-2 * run.radius * run.device.segments[0].material), 0.25)
    assert arc_length(run.backbone())[-1] < 0.11


def test_too_hard_a_draw_is_an_error_that_says_so(monkeypatch):
    monkeypatch.setattr(variety, 'DARKER', 2.0)
    monkeypatch.setattr(variety, 'ATTEMPTS', 2)
    with pytest.raises(ValueError, match='no wide of seed 5 can be seen'):
        variety.wide_run(5)
