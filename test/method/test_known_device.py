"""What a device's description says of a curve, on rendered pairs with known truth and on depths worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.config import Config, visible_radius
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.device import REFERENCE_KEV, REST, Device, Ring, Segment, attenuation, load_device
from fluoro_shape_ros.geometry.cameras import distort, project
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.imaging.prepare import sheet_of
from fluoro_shape_ros.method.fit.fit import fit
from fluoro_shape_ros.method.known_device import (
    AGAINST,
    ALIKE,
    FOR,
    LENGTH,
    MOST,
    SHARE,
    STEP,
    SURE,
    TOGETHER_PX,
    Likeness,
    expected,
    likeness,
    verdict,
)
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.method.tip import tip_is_last
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

PX = 0.3e-3
VIEWS = biplane(arm=CArm(pixel_size_iso=PX, width=512, height=512))
STEPPED = Device((Segment(0.030, 0.0007, 'metal', 0.0005), Segment(REST, 0.0010, 'metal', 0.0006)))
RINGED = Device((Segment(REST, 0.0008, 110.0),),
                bands=tuple(Ring(at, 0.002, 0.0009, 'platinum') for at in (0.002, 0.006, 0.010)))
ROD = Device((Segment(REST, 0.0008, 'metal'),))
WHOLE = [np.full((512, 512), 255, np.uint8)] * 2
MIDDLE = 1e-7           # m to either side of it, as good as nothing


def scene_of(device, seed=0):
    return xray_run(seed, views=VIEWS, lengths=(0.06, 0.07), anatomy=False, device=device).scene()


@pytest.fixture(scope='module', params=[STEPPED, RINGED, load_device('coil'), load_device('ep')],
                ids=['stepped', 'ringed', 'coil', 'ep'])
def seen(request):
    """A device whose ends differ, and a scene of it."""
    return request.param, scene_of(request.param)


def said(device, scene, images=None, reverse=False):
    images = scene.frame.images if images is None else images
    return likeness(device, scene.truth[::-1 if reverse else 1], sheet_of(images, WHOLE, VIEWS, 'dark'),
                    visible_radius(device))


# ---- what is expected


def test_the_depth_through_the_middle_is_that_of_the_walls():
    mu = attenuation('metal', REFERENCE_KEV)
    depth = expected(STEPPED, 0.05, MIDDLE)
    assert len(depth) == 500
    assert_allclose(depth[:300], mu * 2 * 0.0002, rtol=1e-6)
    assert_allclose(depth[300:], mu * 2 * 0.0004, rtol=1e-6)


def test_bands_and_disks_add_what_stands_out_and_repeat():
    device = Device((Segment(REST, 0.0005, 100.0),), disks=(Ring(0.001, 0.0005, 0.002, 40.0, every=0.004),))
    depth = expected(device, 0.02, MIDDLE)
    at = STEP * (np.arange(200) + 0.5)
    on = np.any([(at > 0.001 + 0.004 * k) & (at < 0.0015 + 0.004 * k) for k in range(5)], axis=0)
    assert_allclose(depth, 0.1 + np.where(on, 40.0 * 2 * 0.0015, 0.0), rtol=1e-6)


def test_a_part_shorter_than_a_step_has_its_share():
    device = Device((Segment(REST, 0.0005, 100.0),), bands=(Ring(0.00105, STEP / 4, 0.001, 1000.0),))
    assert_allclose(expected(device, 0.002, MIDDLE)[10], 0.1 + 0.25, rtol=1e-6)


def test_over_the_whole_width_the_mean_chord_of_a_circle_counts():
    assert_allclose(expected(Device((Segment(REST, 0.001, 100.0),)), 0.01, 0.001), 100 * np.pi * 0.001 / 2, rtol=1e-6)
    assert_allclose(expected(Device((Segment(REST, 0.001, 100.0),)), 0.01, 0.002), 100 * np.pi * 0.001 / 4, rtol=1e-6)


def test_a_device_of_known_length_goes_on_as_it_is_at_its_base():
    short = Device((Segment(0.030, 0.0007, 'metal', 0.0005), Segment(0.005, 0.0010, 'metal', 0.0006)))
    assert_allclose(expected(short, 0.05, MIDDLE), expected(STEPPED, 0.05, MIDDLE))


# ---- what images say


def test_the_tip_is_told_from_the_base_whichever_way_the_curve_runs(seen):
    device, scene = seen
    there, back = said(device, scene), said(device, scene, reverse=True)
    assert there.last_is_tip > SURE and there.last > there.neither
    assert back.last_is_tip < -SURE and back.first > back.neither
    assert_allclose(back.last_is_tip, -there.last_is_tip, rtol=0.1)


@pytest.mark.parametrize('display', [lambda i: 2.5 * i, lambda i: 255 * (i / 255)**0.6, lambda i: 255 * (i / 255)**1.8,
                                     lambda i: 50 * np.log(i)],
                         ids=['gain', 'brighter', 'darker', 'logarithm'])
def test_a_display_does_not_exchange_them(seen, display):
    device, scene = seen
    images = [display(np.maximum(i.astype(np.float32), 1)) for i in scene.frame.images]
    assert said(device, scene, images).last_is_tip > SURE


def test_planes_may_show_it_otherwise(seen):
    """As where they have other energies or scatter."""
    device, scene = seen
    a, b = (np.maximum(i.astype(np.float32), 1) for i in scene.frame.images)
    assert said(device, scene, (a, 150 + 0.4 * b)).last_is_tip > SURE


def test_a_device_that_is_the_same_all_along_tells_nothing():
    found = said(ROD, scene_of(ROD))
    assert abs(found.last_is_tip) < 0.1 and abs(found.last - found.neither) < 0.1


def test_a_rod_does_not_look_like_a_ringed_device():
    found = said(RINGED, scene_of(ROD))
    assert max(found.first, found.last) < found.neither - SURE


def test_ends_found_two_mm_off_do_not_matter(seen):
    device, scene = seen
    s = np.arange(0, arc_length(scene.truth)[-1] - 0.002, STEP)
    assert said(device, replace(scene, truth=at_arc_length(scene.truth, s))).last_is_tip > SURE


@pytest.mark.parametrize('where', [0.1, 0.5, 0.9])
def test_what_is_hidden_says_no_more_than_so_much(where):
    """Something opaque over a few mm in one plane."""
    scene = scene_of(STEPPED, 1)
    images, before = [i.copy() for i in scene.frame.images], said(STEPPED, scene)
    point = at_arc_length(scene.truth, np.array([where * arc_length(scene.truth)[-1]]))
    (u, v), = distort(VIEWS[0], project(VIEWS[0].P, point)).round().astype(int)
    images[0][v - 4:v + 5, u - 4:u + 5] = 3
    after = said(STEPPED, scene, images)
    hidden_px = 9 * np.sqrt(2) + 14     # and what is blurred
    assert after.last_is_tip > SURE
    assert (abs(after.last_is_tip - before.last_is_tip)
            < 0.5 * MOST**2 * hidden_px / TOGETHER_PX + 0.25 * abs(before.last_is_tip))    # scatter is measured anew


def test_a_curve_too_short_or_outside_the_images_tells_nothing():
    scene = scene_of(STEPPED)
    sheet = sheet_of(scene.frame.images, WHOLE, VIEWS, 'dark')
    assert likeness(STEPPED, scene.truth[:20], sheet, 0.0007) == ALIKE
    assert likeness(STEPPED, scene.truth + [0.3, 0, 0.3], sheet, 0.0007) == ALIKE


def test_what_looks_like_neither_tells_no_ends_apart():
    assert Likeness(-20.0, -10.0, -10.0 + 0.9 * SURE).last_is_tip == 10.0
    assert Likeness(-20.0, -10.0, -10.0 + 1.1 * SURE).last_is_tip == 0.0


# ---- which end is the tip


ENDS = np.array([[0.0, 0, 0], [0.1, 0, 0]])
LINE = np.linspace(*ENDS, 11)


def test_the_description_counts_before_a_guess_and_after_what_is_known():
    border = lambda: np.array([[200.0, 200], [100, 100]])       # noqa: E731
    of = lambda nats: lambda: Likeness(-nats, 0.0, -9.0)        # noqa: E731
    assert tip_is_last(ENDS, (False, False), border, alike=of(SURE + 0.1)) == (True, False)
    assert tip_is_last(ENDS, (False, False), border, alike=of(-SURE - 0.1)) == (False, False)
    # not sure: a guess, and said to be one
    assert tip_is_last(ENDS, (False, False), border, alike=of(SURE - 0.1)) == (False, True)
    assert tip_is_last(ENDS, (False, False), border, previous=LINE[::-1], alike=of(9.0)) == (False, False)
    assert tip_is_last(ENDS, (False, False), border, base_position=ENDS[1], alike=of(9.0)) == (False, False)
    assert tip_is_last(ENDS, (False, True), border, alike=of(9.0)) == (False, False)


# ---- whether it is that device


@pytest.fixture(scope='module')
def rod_fit():
    scene = scene_of(ROD)
    return fit(sheet_of(scene.frame.images, WHOLE, VIEWS, 'dark'), scene.truth, 0.0008)


def of_length(f, off):
    """A rod so much longer than a fit, m."""
    return Device((Segment(f.stop - f.start + off, 0.0008, 'metal'),))


def test_a_length_that_is_right_speaks_for_it_and_a_wrong_one_by_its_deviation(rod_fit):
    f = replace(rod_fit, end_sigma=np.zeros(2))
    assert verdict(of_length(f, 0.0), lambda: ALIKE, f, True)[0] == FOR
    device = of_length(f, 0.008)
    square = 0.008**2 / (LENGTH**2 + (SHARE * device.length)**2)
    assert_allclose(verdict(device, lambda: ALIKE, f, True)[0], FOR - square / 2)
    found, words = verdict(of_length(f, 0.1), lambda: ALIKE, f, True, 'mine')
    assert (found == AGAINST and words == f'it is {1e3 * (f.stop - f.start):.0f} mm long, '
                                          f'and mine {1e3 * (f.stop - f.start) + 100:.0f} mm')


def test_a_device_that_leaves_the_field_may_be_longer_but_not_shorter(rod_fit):
    f = replace(rod_fit, open_end=np.array([True, False]))
    assert verdict(of_length(f, 0.1), lambda: ALIKE, f, True)[0] == 0
    assert verdict(of_length(f, -0.04), lambda: ALIKE, f, True)[0] == AGAINST


def test_what_it_looks_like_counts_for_the_end_that_is_taken_for_the_tip(rod_fit):
    alike, device = lambda: Likeness(-9.0, -2.0, -1.0), of_length(rod_fit, 0.0)
    found, words = verdict(device, alike, rod_fit, True, 'mine')
    assert_allclose(found, FOR - 1.0, atol=1e-3)
    assert words == 'it does not look like mine along it'
    assert verdict(device, alike, rod_fit, False)[0] == AGAINST


def test_without_a_known_length_nothing_is_asked(rod_fit):
    def asked():
        raise AssertionError
    assert verdict(ROD, asked, rod_fit, True)[0] == verdict(None, asked, rod_fit, True)[0] == 0


# ---- the whole way


def file_of(folder, text):
    path = folder / 'mine.yaml'
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize('seed, method', [(0, 'spline'), (1, 'spline'), (1, 'paper')])
def test_the_description_takes_the_place_of_radius_and_base(seed, method):
    """A pair whose tip is farther from the border than its base, as a guess has it, and one where it is not."""
    scene = scene_of(load_device('coil'), seed)
    guessed = reconstruct(scene.frame, Config.from_values(robot_radius=0.00045))
    assert (guessed.warnings == ('tip_ambiguous',)
            and np.linalg.norm(guessed.shape.tip - scene.truth[(-1, 0)[seed]]) < 1e-3)
    found = reconstruct(scene.frame, Config.from_values(device='coil', robot_radius=0.01, method=method))
    assert found.outcome is Outcome.OK and found.warnings == ()
    assert np.linalg.norm(found.shape.tip - scene.truth[-1]) < 2e-3


def test_a_curve_that_contradicts_the_description_is_refused_in_words(tmp_path):
    scene = scene_of(ROD)
    length = arc_length(scene.truth)[-1]
    same = reconstruct(scene.frame, Config.from_values(robot_radius=0.0008, min_confidence=0.9))
    assert same.outcome is Outcome.OK
    known = f'segments: [{{length: {length:.4f}, radius: 0.0008, material: metal}}]'
    right = reconstruct(scene.frame, Config.from_values(device=file_of(tmp_path, known), min_confidence=0.9))
    assert right.outcome is Outcome.OK and right.confidence > same.confidence
    for text, words in ((known.replace(f'{length:.4f}', '0.2000'), 'mm long, and'),
                        (known.replace('material: metal', 'attenuation: 110')
                         + '\nbands: [{at: 0.002, length: 0.004, radius: 0.0009, material: platinum, every: 0.012}]',
                         'it does not look like')):
        device = file_of(tmp_path, text)
        found = reconstruct(scene.frame, Config.from_values(device=device, min_confidence=0.97))
        assert found.outcome is Outcome.LOW_CONFIDENCE and words in found.detail and device in found.detail
        assert found.confidence < same.confidence


def test_silhouettes_are_not_asked_what_they_look_like():
    scene = scene_of(ROD)
    images = tuple(np.where(i < 0.85 * np.median(i), 255, 0).astype(np.uint8) for i in scene.frame.images)
    found = reconstruct(replace(scene.frame, images=images), Config.from_values(device='ep', image_kind='silhouette'))
    assert found.outcome is Outcome.OK and found.warnings == ('tip_ambiguous',)
