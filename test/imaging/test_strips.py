"""Strips across a drawn line of known place: offset, presence, width, speed."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import ndtr

from fluoro_shape_ros.data import Distortion
from fluoro_shape_ros.geometry.cameras import decompose, distort, project, undistort
from fluoro_shape_ros.imaging.profiles import (
    WIDTHS,
    apparent_width,
    background,
    likeness,
    odd_width,
    own_shadow,
    pieces,
    shadow,
)
from fluoro_shape_ros.imaging.strips import (
    FOUND_PX,
    Measurement,
    Model,
    Sheet,
    Strips,
    clutter,
    cut,
    cut_along,
    depth_across,
    depths,
    half_width_range,
    lay_out,
    local_spread,
    measure,
    search,
)
from fluoro_shape_ros.sim.carm import CArm, view

HALF_WIDTH = 2.0        # px
PX = 0.3e-3             # m at the isocentre
VIEW = view('a', 0.0, arm=CArm(pixel_size_iso=PX, width=256, height=256))
FIELD = np.full((256, 256), 255, np.uint8)
S = (np.arange(200) - 99.5) * PX
V, U = np.mgrid[0:256, 0:256].astype(float)
ALL = np.ones(len(S), bool)
REACH = half_width_range(HALF_WIDTH)


def line(direction):
    """(N, 3) points a px apart on a straight line through the isocentre, and their tangents."""
    d = np.array(direction, float) / np.linalg.norm(direction)
    return S[:, None] * d, np.broadcast_to(d, (len(S), 3))


def draw(direction, offset_px=0.0, *, depth=30.0, half_width=HALF_WIDTH, noise=0.0, upto_px=np.inf, at=(U, V), seed=0):
    """An image of a straight device that lies `offset_px` beside the projected `line`, to its right seen along it, over
    a sloping background."""
    p, q = project(VIEW.P, line(direction)[0][[0, -1]])
    t = (q - p) / np.linalg.norm(q - p)
    across = (at[1] - p[1]) * t[0] - (at[0] - p[0]) * t[1] - offset_px
    along = (at[0] - p[0]) * t[0] + (at[1] - p[1]) * t[1]
    x = np.arange(-40, 40, 0.02)
    dark = depth * np.interp(across, x, shadow(half_width, x), 0, 0) * ndtr(upto_px - along)
    return (200 + 0.1 * at[0] - dark + np.random.default_rng(seed).normal(0, noise, U.shape)).astype(np.float32)


def only(planes):
    """The arrays of the one plane looked at."""
    return SimpleNamespace(**{k: v[0] if k != 'offsets_px' or isinstance(planes, Measurement) else v
                              for k, v in vars(planes).items()})


def strips_of(direction, image=None, field=FIELD, view=VIEW, reach=REACH, **drawing):
    return cut(Sheet.of([draw(direction, **drawing) if image is None else image], [field], [view]),
               *line(direction), reach)


def measured(strips, on=None):
    return only(measure(strips, Model.of(shadow(HALF_WIDTH, strips.offsets_px)[None], strips.offsets_px), on))


def searched(strips):
    return only(search(strips, shadow(HALF_WIDTH, np.arange(-REACH, REACH + 1))[None]))


def alike(strips):
    return likeness(np.median(strips.profiles[0], axis=0), HALF_WIDTH)[np.abs(WIDTHS - 1).argmin()]


@pytest.mark.parametrize('direction', [(1, 0, 0), (0, 0, 1), (-1, 0, 0.4), (1, 0.3, 1)])
@pytest.mark.parametrize('offset', [0.0, 0.07, -0.15])
def test_a_known_offset_is_measured(direction, offset):
    strips = strips_of(direction, offset_px=offset)
    m = measured(strips)
    assert abs(np.median(m.offset_px) - offset) < 0.02
    assert np.abs(m.offset_px - offset).max() < 0.07        # interpolation between pixels
    assert_allclose(m.presence, 1, atol=0.03)


def test_a_background_that_curves_changes_nothing():
    image = draw((1, 0, 0), 0.1, noise=0.5)
    bowl = (0.2 * (V - 120) ** 2).astype(np.float32)
    flat, curved = (measured(strips) for strips in (strips_of((1, 0, 0), i) for i in (image, image + bowl)))
    assert_allclose(curved.offset_px, flat.offset_px, atol=1e-3)
    assert_allclose(curved.variance, flat.variance, rtol=1e-2)


def test_offsets_settle_where_strips_follow_them():
    # a start 1.5 px off: each measurement moves the strips, as the fit does
    at = 0.0
    for _ in range(4):
        strips = strips_of((1, 0, 0), offset_px=1.5 - at)
        at += np.median(measured(strips).offset_px)
    assert abs(at - 1.5) < 0.02


@pytest.mark.parametrize('noise', [1.0, 4.0])
def test_the_variance_is_that_of_the_scatter(noise):
    strips = strips_of((1, 0, 0.4), offset_px=0.2, noise=noise)
    m = measured(strips)
    z = (m.offset_px - 0.2) / np.sqrt(m.variance)
    assert 0.8 < z.std() < 1.3                              # interpolated noise is correlated
    assert 0.75 < (m.presence - 1).std() / m.presence_sigma < 1.3


def test_presence_is_1_on_the_device_and_0_beyond_it():
    strips = strips_of((1, 0, 0), upto_px=120.0, noise=0.5)
    on = np.arange(len(S)) < 120
    m = measured(strips, on)
    assert_allclose(m.presence[:115], 1, atol=0.1)
    assert_allclose(m.presence[126:], 0, atol=0.1)
    assert 0.3 < m.presence[120] < 0.7


def test_outside_the_field_nothing_is_measured():
    field = FIELD.copy()
    field[:, 150:] = 0
    # u grows along it: the image shows the patient's right to the left
    strips = strips_of((-1, 0, 0), field=field, noise=0.5)
    u = strips.centers_px[0, :, 0]
    assert (np.diff(u) > 0).all()
    inside = strips.inside[0]
    assert (inside == (u < 149.5)).all()
    m = measured(strips)
    assert np.isinf(m.variance[~inside]).all() and np.isfinite(m.variance[inside]).all()
    assert np.isnan(m.presence[~inside]).all() and np.isfinite(m.presence[inside]).all()


def test_speed_is_the_magnification_times_the_sine_of_the_ray():
    # the beam runs along y
    for direction, sine in (((1, 0, 0), 1.0), ((1, 1, 0), np.sqrt(0.5)), ((0, 1, 2), 2 / np.sqrt(5))):
        strips = only(strips_of(direction))
        middle = slice(95, 105)
        assert_allclose(strips.speed[middle], sine / PX, rtol=3e-3)
        assert_allclose(np.einsum('ni,ni->n', strips.normals[middle], np.gradient(strips.centers_px, axis=0)[middle]),
                        0, atol=1e-3)


def test_a_sheet_samples_each_plane_as_if_it_were_alone():
    rng = np.random.default_rng(2)
    images = [rng.random(size, np.float32) for size in ((40, 50), (60, 30))]       # of different sizes
    fields = [np.full(i.shape, 255, np.uint8) for i in images]
    fields[1][:10] = 0
    u, v = (rng.uniform(-8, 68, (2, 25, 7)).astype(np.float32) for _ in range(2))
    sheet = Sheet.of(images, fields, [VIEW, VIEW])
    columns, rows = sheet.places(np.stack([u[..., 3], v[..., 3]], axis=2), np.zeros((2, 25, 2)), np.arange(-3, 4))
    for k in range(2):
        at = np.repeat(u[k, :, 3:4], 7, axis=1), np.repeat(v[k, :, 3:4], 7, axis=1)
        alone = cv2.remap(images[k], *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        lit = cv2.remap(fields[k], *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
        inside = (at[0] > 0) & (at[0] < images[k].shape[1] - 1) & (at[1] > 0) & (at[1] < len(images[k]) - 1)
        assert inside.any() and not inside.all()
        # coordinates are rounded to 1/32 px
        assert_allclose(sheet.sample(columns, rows, cv2.INTER_CUBIC)[k][inside], alone[inside], atol=2e-2)
        assert_array_equal(sheet.exposed(columns, rows)[k], lit)


def test_strips_follow_a_distorted_image():
    K, _, _ = decompose(VIEW.P)
    raw = K + [[0, 0, 1.5], [0, 0, -2.0], [0, 0, 0]]
    bent = replace(VIEW, distortion=Distortion('plumb_bob', raw, np.array([3.0, 0, 0.02, 0.02, 0]), np.eye(3)))
    pixels = np.c_[U.ravel(), V.ravel()]
    ideal = undistort(bent, pixels)
    assert np.abs(ideal - pixels).max() > 1
    image = draw((1, 0, 0.6), 0.1, at=ideal.T.reshape(2, 256, 256))
    known = strips_of((1, 0, 0.6), image, view=bent)
    assert np.abs(measured(known).offset_px - 0.1).max() < 0.05
    ignored = strips_of((1, 0, 0.6), image)
    found = measured(ignored)
    assert not (np.isfinite(found.variance) & (np.abs(found.offset_px - 0.1) < 0.3)).all()


@pytest.mark.parametrize('offset', [-7.0, 0.0, 3.4, 6.0])
def test_search_finds_a_line_far_off(offset):
    strips = strips_of((0, 0, 1), reach=REACH + 8, offset_px=offset, noise=2.0)
    found = searched(strips)
    assert (abs(np.median(found.offset_px) - offset) < 0.1
            and np.mean(np.abs(found.offset_px - offset) < FOUND_PX) > 0.95)
    assert np.isfinite(found.variance).mean() > 0.95


def test_search_does_not_believe_what_hides_the_device():
    image = draw((-1, 0, 0), noise=2.0)
    image[100:160, 80:120] = 20
    strips = strips_of((-1, 0, 0), image, reach=REACH + 8)
    u = strips.centers_px[0, :, 0]
    believed = np.isfinite(searched(strips).variance)
    assert not believed[(u > 85) & (u < 115)].any() and believed[(u < 70) | (u > 130)].mean() > 0.95


def test_a_shadow_by_hand():
    # chord 2 sqrt(h^2 - x^2): its area is pi h^2, its height 2 h; blur keeps the area and lowers the peak
    x = np.arange(-30, 30.01, 0.1)
    for h in (1.0, 2.0, 6.0):
        y = shadow(h, x)
        assert_allclose(y, y[::-1], atol=1e-9)
        assert y.max() == y[len(y) // 2] == pytest.approx(1, abs=1e-3)
        assert np.pi * h / 2 < y.sum() * 0.1 < np.pi * h / 2 * (1.8 if h < 2 else 1.25)
    # blur hardly shows
    assert_allclose(shadow(20.0, np.array([0.0, 10.0, 15.0])), [1, np.sqrt(0.75), np.sqrt(1 - 0.75**2)], atol=5e-3)


@pytest.mark.parametrize('half_width, low, high',
                         [(2.0, 0.995, 1.0), (1.5, 0.97, 1.0), (2.5, 0.97, 1.0), (5.0, 0.3, 0.86)])
def test_likeness_knows_the_devices_width(half_width, low, high):
    strips = strips_of((1, 0, 0), half_width=half_width, noise=1.0)
    assert low < alike(strips) <= high


def test_likeness_does_not_mind_noise_that_is_known():
    """A shadow with as much noise as it has of its own is like one by 1 / sqrt(2) to the eye."""
    offsets = np.arange(-10.0, 11.0)
    parabolas = np.vander(offsets, 3)
    clean = shadow(HALF_WIDTH, offsets) - parabolas @ np.linalg.lstsq(parabolas, shadow(HALF_WIDTH, offsets))[0]
    sigma = np.linalg.norm(clean) / np.sqrt(len(offsets) - 3)
    noisy = -shadow(HALF_WIDTH, offsets) + np.random.default_rng(0).normal(0, sigma, (4000, len(offsets)))
    own = np.abs(WIDTHS - 1).argmin()
    assert np.median(likeness(noisy, HALF_WIDTH)[:, own]) == pytest.approx(np.sqrt(0.5), abs=0.03)
    assert np.median(likeness(noisy, HALF_WIDTH, sigma)[:, own]) > 0.95
    assert likeness(noisy, HALF_WIDTH, 10 * sigma).max() <= 1       # more noise than there can be
    # what is nothing but noise stays so
    assert np.median(np.abs(likeness(noisy + shadow(HALF_WIDTH, offsets), HALF_WIDTH, sigma)[:, own])) < 0.5


def test_a_bright_line_is_the_opposite_and_an_edge_is_unlike():
    bright = strips_of((1, 0, 0), depth=-30.0)
    assert alike(bright) < -0.95
    edge = strips_of((1, 0, 0), np.where(V > 127.5, 200, 100).astype(np.float32))
    assert abs(alike(edge)) < 0.2


def test_the_devices_own_shadow_replaces_the_expected_one_where_there_is_enough_of_it():
    strips = strips_of((1, 0, 0), half_width=2.5, noise=0.5)
    expected = shadow(HALF_WIDTH, strips.offsets_px)
    beside = background(expected, strips.offsets_px)
    own = own_shadow(strips.profiles[0], beside, ALL, expected)
    assert_allclose(own, shadow(2.5, strips.offsets_px), atol=0.06)
    assert np.abs(own - expected).max() > 0.1
    assert_allclose(own, own[::-1], atol=1e-6)
    assert_allclose(own_shadow(strips.profiles[0], beside, np.arange(len(S)) < 10, expected), expected)
    nothing = strips_of((1, 0, 0), depth=0.0, noise=0.5)
    assert_allclose(own_shadow(nothing.profiles[0], beside, ALL, expected), expected)


def test_strips_along_lines_of_pixels():
    points = np.c_[np.arange(30, 200.0), np.full(170, 127.5)]
    strips, of = cut_along(draw((1, 0, 0), offset_px=0.0), FIELD, [points[:30], points + [0, 0.15]], REACH)
    assert of.tolist() == [0] * 10 + [1] * 57
    assert_allclose(np.abs(strips.normals), np.tile([0, 1], (len(strips.normals), 1)), atol=1e-9)
    assert np.ptp(strips.centers_px[of == 1, 0]) > 160
    planes = Strips(*(a if k == 'offsets_px' else a[None, of == 1] for k, a in vars(strips).items()))
    assert_allclose(measured(planes).offset_px * strips.normals[of == 1, 1], -0.15, atol=0.02)


def test_pieces_are_medians_along_each_line_and_a_short_line_is_one():
    along = np.r_[np.arange(70.0), np.arange(5.0), np.arange(40.0)][:, None] * np.ones(3)
    of, good = np.repeat([0, 2, 3], [70, 5, 40]), np.ones(115, bool)        # nothing of line 1
    good[75:84] = False
    medians, line = pieces(along, good, of)
    assert line.tolist() == [0, 0, 2, 3]
    assert_allclose(medians[:, 0], [15, 46, 2, 24])
    nothing, none = pieces(along, np.zeros(115, bool), of)
    assert nothing.shape == (0, 3) and len(none) == 0


def test_how_wide_a_line_looks_and_when_that_is_odd():
    for factor in (0.7, 1.0, 1.4):
        image = draw((1, 0, 0), half_width=factor * HALF_WIDTH, noise=0.5)
        strips = strips_of((1, 0, 0), image)
        width, alike = apparent_width([likeness(pieces(strips.profiles[0], ALL)[0], HALF_WIDTH)])
        assert width == pytest.approx(factor, rel=0.08) and alike[0] > 0.99
    assert odd_width(0.88, 2.0) == odd_width(1.0, 2.0) == odd_width(0.7, 2.0) == 0
    assert odd_width(1.5, 2.0) > odd_width(1.4, 2.0) > 0 and odd_width(0.4, 2.0) > 0
    assert odd_width(1.5, 1.0) < odd_width(1.5, 2.0) < odd_width(1.5, 4.0)     # the fewer pixels, the less is known


def test_depths_in_the_middle_are_those_of_the_whole_profile():
    shape = shadow(HALF_WIDTH, np.arange(-6, 7))
    profiles = np.random.default_rng(0).normal(500, 20, (30, 17)).astype(np.float32)
    assert_allclose(profiles @ depths(shape, 5), depth_across(profiles, shape)[:, 6:11], atol=1e-2)


@pytest.mark.parametrize('direction', [(0.2, 0, 1), (1, 0, 0.4)])
def test_clutter_is_what_noise_makes_of_a_line_that_is_not_there(direction):
    """A matched filter of unit depth has the standard deviation noise / |shadow|, over `along` rows its root less; the
    device in the middle does not count."""
    shape = shadow(HALF_WIDTH, np.arange(-6, 7))
    for noise, depth in ((3.0, 0.0), (3.0, 60.0), (6.0, 0.0)):
        strips = strips_of(direction, noise=noise, depth=depth, reach=40)
        spread = clutter(strips, shape[None], 12.0, np.array([3]), 1000)
        # interpolation smooths a little
        assert_allclose(spread, noise / np.linalg.norm(shape - shape.mean()) / np.sqrt(3), rtol=0.3)


def test_the_spread_is_that_of_the_rows_around():
    rng = np.random.default_rng(1)
    values = rng.normal(5.0, np.where(np.arange(400) < 200, 1.0, 4.0)[:, None], (400, 50))
    spread = local_spread(values, 40)
    assert_allclose(spread[:160], 1.0, rtol=0.1)
    assert_allclose(spread[240:], 4.0, rtol=0.1)
    assert (np.diff(spread[180:220]) > 0).all()
    assert_allclose(local_spread(7 * values - 3, 40), 7 * spread)
    some = rng.normal(0, 3, (200, 100))
    assert_allclose(local_spread(some, 1000), 3.0, rtol=0.02)
    some[:, :20] = 100.0    # a line there
    assert_allclose(local_spread(some, 1000), 3.0, rtol=0.5)


def test_distortion_is_known_at_three_offsets_of_a_strip():
    bent = replace(VIEW, distortion=Distortion('plumb_bob', decompose(VIEW.P)[0],
                                               np.array([-0.3, 0.1, 1e-3, -1e-3, 0.0]), np.eye(3)))
    sheet = Sheet.of([draw((1, 0, 0.4))], [FIELD], [bent])
    centers, normals, _ = (x for x in lay_out([bent], *line((1, 0, 0.4))))
    offsets = np.arange(-20.0, 21.0)
    u, v = sheet.places(centers, normals, offsets)
    exact = distort(bent, (centers[0][:, None] + normals[0][:, None] * offsets[:, None]).reshape(-1, 2)).reshape(-1, 41,
                                                                                                                 2)
    inside = (exact[..., 1] > 0) & (exact[..., 1] < 255)
    assert np.abs(np.stack([u[0], v[0] - sheet.top[0]], axis=-1) - exact)[inside].max() < 0.01
