"""Scenes: where the device stands, what is in the images, and that a seed is a seed."""

import numpy as np
import pytest

from fluoro_shape_ros.geometry.cameras import pixels_per_metre, plane_angle, project, source
from fluoro_shape_ros.sim import anatomy, carm, placement, scenes, shapes, xray

SMALL = carm.biplane(arm=carm.CArm(pixel_size_iso=1e-3, width=320, height=320))
OBLIQUE = carm.biplane((-0.3, 0.2), (0.9, -0.1), carm.CArm(pixel_size_iso=1e-3, width=320, height=300))
SHORT = (0.067, 0.1)


def small(seed, **options):
    return scenes.xray_run(seed, views=SMALL, lengths=SHORT, **options)


def angles_to(directions, points, others):
    """(N,) rad between unsigned 3-D or image directions at points and others."""
    cosine = (np.abs(np.sum(directions * others, axis=1)) / np.linalg.norm(directions, axis=1)
              / np.linalg.norm(others, axis=1))
    return np.arccos(np.minimum(cosine, 1))


@pytest.mark.parametrize('views', [SMALL, OBLIQUE])
@pytest.mark.parametrize('seed', range(4))
def test_device_stands_inside_and_is_well_seen(views, seed):
    truth = scenes.xray_run(seed, views=views, lengths=SHORT, kind=('spline', 'cannula')[seed % 2],
                            anatomy=False).backbone()
    middle, tangent = (truth[1:] + truth[:-1]) / 2, np.diff(truth, axis=0)
    for view, other in (views, views[::-1]):
        uv = project(view.P, truth)
        assert uv.min() >= 39 and (uv[:, 0].max() <= 320 - 40) and (uv[:, 1].max() <= view.height - 40)
        assert np.rad2deg(angles_to(tangent, middle, middle - source(view.P)).min()) > 19.5
        # the epipolar line is the image of the other plane's ray
        line = project(view.P, middle + 1e-3 * (middle - source(other.P))) - project(view.P, middle)
        assert np.mean(np.rad2deg(angles_to(np.diff(uv, axis=0), middle, line)) > 20) > 0.78


def test_a_device_along_a_ray_or_an_epipolar_line_is_not_well_seen():
    rod = np.linspace(-0.03, 0.03, 100)[:, None]
    assert placement.well_seen(rod * [0, 0, 1], SMALL)
    assert not placement.well_seen(rod * [0, 1, 0], SMALL)      # along plane A's beam
    assert not placement.well_seen(rod * [0.7, 0.7, 0.1], SMALL)    # in the plane of both beams
    assert placement.well_seen(rod * [1, 0, 0.5], SMALL)        # 27 degrees off plane A's epipolar lines,
                                                                # which run along x
    assert not placement.well_seen(rod * [1, 0, 0.3], SMALL)    # 17


@pytest.mark.parametrize('seed', range(3))
def test_entering_device_comes_in_through_both_borders(seed):
    run = small(seed, entering=True, anatomy=False)
    whole, truth = run.backbone(), run.scene().truth
    first, tip, outside = truth[0], truth[-1], whole[0]
    np.testing.assert_array_equal(tip, whole[-1])
    rooms = [np.minimum(project(v.P, first), 319 - project(v.P, first)).min() for v in SMALL]
    assert -0.5 <= min(rooms) < 0.2         # the first true point stands on the border of the tighter image
    for view in SMALL:
        assert ((project(view.P, outside) < -30) | (project(view.P, outside) > 350)).any()
        assert 39 <= project(view.P, tip).min() and project(view.P, tip).max() <= 280
    assert np.ptp(np.linalg.norm(np.diff(whole, axis=0), axis=1)) < 1e-7     # no seam between shaft and shape


def test_the_same_seed_gives_the_same_images_and_another_does_not():
    options = {'clutter': scenes.CLUTTER, 'entering': True}
    first, again, other = (small(seed, **options).scene() for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.truth, again.truth)
    for k in (0, 1):
        np.testing.assert_array_equal(first.frame.images[k], again.frame.images[k])
        assert (first.frame.images[k] != other.frame.images[k]).mean() > 0.5
    assert (first.frame.images[0] != first.frame.images[1]).mean() > 0.5


def test_index_changes_the_noise_alone():
    run = small(1)
    first, second = run.scene(index=0), run.scene(index=1)
    np.testing.assert_array_equal(first.truth, second.truth)
    difference = first.frame.images[0].astype(float) - second.frame.images[0]
    assert 1 < difference.std() < 30 and abs(difference.mean()) < 0.2


def test_time_moves_the_device():
    run = small(1)
    first, later = run.scene(0.0), run.scene(2.0)
    assert np.linalg.norm(first.truth[-1] - later.truth[-1]) > 1e-3
    np.testing.assert_array_equal(later.truth, shapes.moving(run.shape, 2.0).backbone())


@pytest.mark.parametrize('seed', range(4))
def test_device_stays_inside_while_it_moves(seed):
    run = small(seed, kind=('spline', 'cannula')[seed % 2], anatomy=False)
    for t in np.linspace(0, 60, 40):
        for view in SMALL:
            assert 35 < project(view.P, run.backbone(t)).min() and project(view.P, run.backbone(t)).max() < 285


@pytest.mark.parametrize('run', [small(2), scenes.protocol_p_run(2, 'xray', views=SMALL, lengths=SHORT)])
def test_without_device_is_the_same_pair_but_for_the_device(run):
    scene, bare = run.scene(index=4), run.without_device(index=4)
    assert bare.views == scene.frame.views
    for image, empty, view in zip(scene.frame.images, bare.images, bare.views):
        changed = np.abs(image.astype(float) - empty) > 8
        near = np.zeros_like(changed)
        u, v = np.rint(project(view.P, run.backbone())).astype(int).T
        for du in range(-4, 5):
            for dv in range(-4, 5):
                near[v + dv, u + du] = True
        assert changed[near].sum() > 30 and not changed[~near].any()


def test_scene_says_what_it_is():
    scene = small(3, radius=0.001).scene(stamp_ns=42)
    assert (scene.seed, scene.radius, scene.frame.stamp_ns, scene.frame.frame_id) == (3, 0.001, 42, scenes.FRAME_ID)
    np.testing.assert_array_equal(scene.base_position, scene.truth[0])
    assert scene.frame.views == SMALL
    assert [image.shape for image in scene.frame.images] == [(320, 320)] * 2


def test_protocol_p_is_the_seeds():
    views = scenes.PROTOCOL_P
    assert plane_angle(views) == pytest.approx(np.pi / 2)
    for v in views:
        assert (v.width, v.height) == (1024, 1024)
        assert pixels_per_metre(v.P, np.zeros((1, 3))) == pytest.approx(1 / 0.523e-3)
    assert (scenes.LENGTHS, scenes.RADIUS) == ((0.067, 0.188), 0.0006)
    scene = scenes.protocol_p(2, 'xray')
    image = scene.frame.images[0] / 255
    assert np.median(image) == pytest.approx(0.75, abs=0.005)
    assert image[:300, :300].var() == pytest.approx(0.002, rel=0.03)
    u, v = np.rint(project(views[0].P, scene.truth[len(scene.truth) // 4:-100:50])).astype(int).T
    assert image[v, u].mean() < 0.45        # a device of 2.3 px, blurred


def test_device_of_protocol_p_has_its_grey_level():
    """Thick enough that blur does not reach its axis."""
    pytest.importorskip('vtkmodules.vtkRenderingOpenGL2')
    thick = np.linspace(-0.03, 0.03, 600)[:, None] * [0, 0, 1]
    for renderer in scenes.RENDERERS:
        image = scenes.grey(thick, 0.008, SMALL[0], renderer)
        assert image[160, 159:161].mean() == pytest.approx(0.12, abs=0.005)
        assert image[160, :100] == pytest.approx(0.75)


def test_device_is_darker_by_its_contrast():
    run = small(1, radius=0.003, exposure=xray.Exposure(contrast=0.3, blur_px=0.3))
    with_device = np.mean([run.scene(index=k).frame.images[0] for k in range(6)], axis=0)
    without = np.mean([run.without_device(index=k).images[0] for k in range(6)], axis=0)
    u, v = np.rint(project(SMALL[0].P, run.backbone()[100:-100:10])).astype(int).T
    ratio = with_device[v, u].sum() / without[v, u].sum()
    assert 0.5 < ratio < 0.75       # 0.7 across the beam, less where the device leans


def test_depth_and_photons_reach_the_image():
    scene = scenes.xray_scene(0, pixel_size_iso=0.3e-3, depth=12, photons=400, anatomy=False)
    image = scene.frame.images[0]
    assert image.dtype == np.uint16 and 1.1 * 255 < image.max() <= 4095
    assert np.median(image) == pytest.approx(0.95 * 4095, rel=0.01)
    # white is cut at full scale
    assert image[:200, :200].std() / image[:200, :200].mean() == pytest.approx(1 / 20, rel=0.3)


@pytest.mark.parametrize('clutter', [('blades',), ('field',), ('blades', 'field')])
def test_device_stands_in_the_lit_field(clutter):
    run = small(7, clutter=clutter, anatomy=False)
    for field, beam in zip(run.fields, run.beams):
        u, v = np.rint(project(field.view.P, run.backbone())).astype(int).T
        assert beam[v, u].min() > 0.5
        dark = np.argwhere(beam < 0.1)[:, ::-1]
        assert len(dark) > 1000
        apart = min(np.linalg.norm(dark - np.array([x, y]), axis=1).min() for x, y in zip(u[::100], v[::100]))
        assert apart > 35


def test_entering_device_begins_where_the_lit_field_does():
    run = small(8, clutter=('field',), anatomy=False, entering=True)
    rooms = [np.hypot(*(project(v.P, run.scene().truth[0]) - 160)) for v in SMALL]
    assert 140 < max(rooms) < 162 and min(rooms) < 162


def test_occluder_hides_a_part_in_plane_b_alone():
    with_plate, without = small(9, clutter=('occluder',)), small(9)
    np.testing.assert_array_equal(with_plate.beams[0], without.beams[0])
    ratio = with_plate.beams[1] / without.beams[1]
    middle = without.backbone()[len(without.backbone()) // 2]
    u, v = np.rint(project(SMALL[1].P, middle)).astype(int)
    assert ratio[v, u] < 0.2 and 0.003 < (ratio < 0.2).mean() < 0.03


def test_second_wire_is_the_same_in_both_planes():
    with_wire, without = small(10, clutter=('wire',)), small(10)
    for a, b in zip(with_wire.beams, without.beams):
        assert 50 < (a / b < 0.97).sum() < 2000


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_text_is_burnt_in_at_the_border(dtype):
    image = anatomy.burn_in(np.full((1024, 1024), 7, dtype))
    assert image.dtype == dtype and image.max() == np.iinfo(dtype).max
    changed = np.argwhere(image != 7)
    assert 200 < len(changed) < 10000 and changed[:, 0].max() < 60 and changed[:, 1].max() < 200


@pytest.mark.parametrize('size', [(320, 320), (301, 457)])
@pytest.mark.parametrize('make', [anatomy.anatomy, anatomy.tissue, anatomy.ribs, anatomy.spine, anatomy.vessels,
                                  anatomy.leads, anatomy.blades, anatomy.intensifier])
def test_anatomy_transmits_a_share_of_the_beam(make, size):
    for seed in range(4):
        beam = make(np.random.default_rng(seed), size)
        assert beam.shape == size and beam.dtype == np.float32
        assert 0 < beam.min() and beam.max() <= 1.0 + 1e-6 and beam.std() > 0.003


@pytest.mark.parametrize('call', [
    lambda: scenes.protocol_p_run(0, 'povray'),
    lambda: scenes.xray_run(0, views=SMALL, clutter=('cat',)),
    lambda: scenes.xray_run(0, views=SMALL, kind='snake'),
])
def test_what_does_not_exist_is_named(call):
    with pytest.raises(ValueError, match='no (renderer|clutter|shape) is called .*there are'):
        call()


def test_a_device_longer_than_the_field_is_refused(monkeypatch):
    monkeypatch.setattr(placement, 'ATTEMPTS', 5)
    with pytest.raises(ValueError, match='no spline of 900 to 950 mm fits well into both fields'):
        scenes.xray_run(0, views=SMALL, lengths=(0.9, 0.95), anatomy=False)


def test_ping_pong_never_jumps():
    found = [scene for scene, _ in zip(scenes.ping_pong('abcd'), range(13))]
    assert ''.join(found) == 'abcdcbabcdcba'
    assert ''.join(scene for scene, _ in zip(scenes.ping_pong('a'), range(3))) == 'aaa'


def test_streams_of_scenes():
    run = small(1, anatomy=False)
    resting, going = list(scenes.still(run, 2)), list(scenes.moving(run, 10.0, 3))
    np.testing.assert_array_equal(resting[0].truth, resting[1].truth)
    np.testing.assert_array_equal(going[2].truth, run.scene(0.2, 2).truth)
    np.testing.assert_array_equal(going[2].frame.images[1], run.scene(0.2, 2).frame.images[1])
