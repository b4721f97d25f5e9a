"""Overlays against hand-derived pixels."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fluoro_shape_ros import overlay as o
from fluoro_shape_ros.data import Centerline, Distortion, Outcome, Reconstruction, Shape
from fluoro_shape_ros.geometry.cameras import distort, make_view, project

SIZE = 512
K = np.array([[1000.0, 0, 255.5], [0, 1000.0, 255.5], [0, 0, 1]])
BARREL = Distortion('plumb_bob', K, np.array([-0.3, 0.05, 0, 0, 0]), np.eye(3))     # some 8 px half-way to the border
VIEWS = (make_view('a', K @ np.c_[np.eye(3), [0, 0, 1]], SIZE, SIZE),               # along z, 1 px is 1 mm
         make_view('b', K @ np.c_[[[0, 0, -1], [0, 1, 0], [1, 0, 0]], [0, 0, 1]], SIZE, SIZE))   # along x
DISTORTED = tuple(replace(v, distortion=BARREL) for v in VIEWS)
GREY = np.full((SIZE, SIZE), 100, np.uint8)


def straight(sigma=0.001):
    """5 cm along +y, the tip 10 cm off the axis of plane A: at (355.5, 255.5 + 150) there."""
    points = np.c_[np.full(51, 0.1), np.linspace(0.1, 0.15, 51), np.zeros(51)]
    return Shape(points, np.linspace(0, 0.05, 51), np.tile(sigma**2 * np.eye(3), (51, 1, 1)), np.zeros((51, 2)))


def found(shape=None, lines=(None, None), **fields):
    return Reconstruction(Outcome.OK, 'ok', shape or straight(), centerlines=lines, **fields)


def rejected(detail='only 3 px', lines=(None, None), **fields):
    return Reconstruction(Outcome.NO_CORRESPONDENCE, detail, centerlines=lines, **fields)


def colour_at(picture, points_px):
    u, v = np.round(points_px).astype(int).T
    return picture[v, u].astype(int)


def near(pixels, colour):
    return (np.abs(pixels - np.array(o.bgr(colour))).max(axis=-1) < 60).mean()


@pytest.mark.parametrize('views', [VIEWS, DISTORTED], ids=['pinhole', 'distorted'])
def test_the_backbone_is_drawn_where_the_image_as_received_shows_it(views):
    picture = o.overlay(GREY, 0, found(), views)
    assert picture.shape == (SIZE, SIZE, 3) and picture.dtype == np.uint8
    track = distort(views[0], project(views[0].P, straight().points[5:-10]))      # up to the ring around the tip
    assert near(colour_at(picture, track), o.FOUND) == 1
    assert np.allclose(track[0], project(VIEWS[0].P, straight().points[5]), atol=0.1) == (views is VIEWS)


def test_a_ring_shows_where_the_tip_is():
    # rows, columns
    ring = np.hypot(*(np.mgrid[:SIZE, :SIZE] - 405.5 + np.array([0, 50])[:, None, None])).round() == o.RING
    red = [o.overlay(GREY, 0, result, VIEWS)[ring].astype(int) @ (-1, -1, 2)
           for result in (found(straight(sigma=1e-5)), rejected())]
    assert np.median(red[0]) > 60 and red[1].max() == 0


def test_what_was_seen_is_drawn_for_a_rejected_pair_too():
    line = Centerline(np.c_[np.full(301, 200.0), np.linspace(100, 400, 301)])
    picture = o.overlay(GREY, 0, rejected(lines=(line, None)), VIEWS)
    assert 0.4 < near(colour_at(picture, line.points_px), o.SEEN) < 0.7      # dashed
    assert near(colour_at(o.overlay(GREY, 0, rejected(), VIEWS), line.points_px), o.SEEN) == 0


def test_dashes_are_as_long_as_their_gaps():
    line = np.c_[np.linspace(0, 20, 9), np.zeros(9)]
    assert np.allclose(o.dashes(line, 4)[:, :, 0], [[0, 1, 2, 3, 4], [8, 9, 10, 11, 12], [16, 17, 18, 19, 20]])
    assert o.dashes(line[:1], 4).shape == (0, 5, 2)


def test_the_ellipse_of_the_tip():
    """Isotropic sigma of 1 mm is 1 px here; 95 % of a Gaussian in the plane lie within sqrt(-2 ln 0.05) sigma."""
    ellipse = o.tip_ellipse(VIEWS[0], straight(0.001))
    # seen at 10 degrees
    assert np.allclose(np.linalg.norm(ellipse - (355.5, 405.5), axis=1), np.sqrt(-2 * np.log(0.05)), atol=0.05)
    assert np.array_equal(ellipse[0], ellipse[-1])
    deep = replace(straight(), covariance=np.tile(np.diag([1e-6, 4e-6, 1e-12]), (51, 1, 1)))
    assert np.allclose(np.ptp(o.tip_ellipse(VIEWS[0], deep), axis=0), 2 * np.sqrt(-2 * np.log(0.05)) * np.array([1, 2]),
                       rtol=1e-3)
    assert o.tip_ellipse(VIEWS[0], straight(np.nan)) is None


def off(curve, point):
    """Distance of a point to the nearest segment of a curve, px."""
    dense = np.concatenate([a + np.linspace(0, 1, 500)[:, None] * (b - a) for a, b in zip(curve, curve[1:])])
    return np.linalg.norm(dense - point, axis=1).min()


@pytest.mark.parametrize('views', [VIEWS, DISTORTED], ids=['pinhole', 'distorted'])
def test_the_epipolar_lines_pass_where_the_other_plane_says(views):
    ends = straight().points[[0, -1]]
    a, b = (distort(v, project(v.P, ends)) for v in views)
    lines = o.tip_lines(views[0], views[1], Centerline(b), None)     # rejected: nobody knows which end is the tip
    assert len(lines) == 2 and max(map(off, lines, a)) < 0.1
    assert np.ptp(lines[0][:, 0]) > SIZE - 20       # all across the image
    assert len(o.tip_lines(views[0], views[1], None, None)) == 0


def test_the_epipolar_line_is_of_the_tip_as_the_other_plane_saw_it():
    """So that it shows an error of the calibration; where that plane saw no such end, it is of the tip found."""
    tip_a, tip_b = (project(v.P, straight().tip) for v in VIEWS)
    wrong = np.array([tip_b + (0, 100), tip_b + (0, 6.0)])
    line, = o.tip_lines(VIEWS[0], VIEWS[1], Centerline(wrong), straight())
    assert 4 < off(line, tip_a) < 8
    line, = o.tip_lines(VIEWS[0], VIEWS[1], Centerline(wrong - (0, 50)), straight())
    assert off(line, tip_a) < 0.05
    line, = o.tip_lines(VIEWS[0], VIEWS[1], None, straight())
    assert off(line, tip_a) < 0.05


def test_a_line_across_the_image():
    points = o.across(np.array([0.0, 1.0, -10.0]), 100, 50)      # v = 10
    assert np.allclose(points[:, 1], 10) and points[:, 0].min() < 2 and points[:, 0].max() > 97
    assert len(o.across(np.array([0.0, 1.0, -200.0]), 100, 50)) == 0


@pytest.mark.parametrize('dtype, scale, offset',
                         [(np.uint8, 1, 0), (np.uint16, 257, 0), (np.uint16, 4, 3000), (np.float32, 1e-3, -0.05)])
def test_any_range_of_grey_gives_the_same_contrast(dtype, scale, offset):
    image = np.full((256, 256), 120, np.uint8)
    image[100:140, 30:220] = 90
    image[20:60, 20:60] = 150
    out = o.stretched((image * float(scale) + offset).astype(dtype))
    assert out.dtype == np.uint8
    assert np.abs(out[[120, 200, 40], [100, 200, 40]].astype(int) - [0, 128, 255]).max() <= 2


def test_neither_noise_nor_the_unexposed_border_sets_the_grey_levels():
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(150, 3, (512, 512)), 0, 255).astype(np.uint8)
    assert o.stretched(image).std() < 60        # noise is not blown up
    round_field = cv2.circle(np.zeros_like(image), (256, 256), 220, 1, -1)
    low, high = o.grey_levels(image * round_field)
    assert low > 75 and high < 200
    assert np.abs(o.stretched(np.full((64, 64), 7, np.float32)) - 127.5).max() < 1  # nothing to see is grey, not black


def test_words():
    assert o.words(found(warnings=('tip_ambiguous',))) == ['ok, 50.0 mm long, tip +-1.00 mm', 'tip ambiguous']
    assert o.words(found(straight(np.nan))) == ['ok, 50.0 mm long']
    assert o.words(rejected('only 3 px')) == ['no result', 'no correspondence: only 3 px']
    assert o.words(rejected('')) == ['no result', 'no correspondence']
    assert o.words(rejected('20 °')) == ['no result', 'no correspondence: 20 ?']      # OpenCV writes ASCII


def test_words_say_how_sure_it_is():
    assert o.words(found(confidence=0.998)) == ['ok, confidence 0.998, 50.0 mm long, tip +-1.00 mm']
    assert (o.words(found(straight(np.nan), confidence=0.998, warnings=('tip_ambiguous',)))
            == ['ok, confidence 0.998, 50.0 mm long', 'tip ambiguous'])
    assert o.words(rejected(confidence=0.0)) == ['no result', 'no correspondence: only 3 px',
                                                 'the best curve has confidence 0.000']
    low = Reconstruction(Outcome.LOW_CONFIDENCE, 'it ends at a wire', confidence=0.4126)
    assert o.words(low) == ['no result', 'confidence too low: it ends at a wire', 'the best curve has confidence 0.413']
    # a line more
    assert strip(o.overlay(GREY, 0, low), o.WORDS)[0].max() > strip(o.overlay(GREY, 0, rejected()), o.WORDS)[0].max()


def strip(picture, colour):
    """Rows and columns of the letters of a colour."""
    return np.nonzero(np.abs(picture.astype(int) - o.bgr(colour)).max(axis=2) < 60)


@pytest.mark.parametrize('size', [512, 1024])
def test_the_reason_is_legible_at_512_px_and_stays_inside(size):
    image = np.full((size, size), 100, np.uint8)
    rows, columns = strip(o.overlay(image, 0, rejected()), o.REJECTED)
    assert np.ptp(rows) * 512 / size >= 9
    long = 'length 12.1 mm is outside [50.0, 80.0] mm and so on; ' * 5
    rows, columns = strip(o.overlay(image, 1, rejected(long)), o.WORDS)
    assert columns.max() < size - 3 and np.ptp(rows) > size / 512 * 30      # several lines
    assert np.array_equal(o.overlay(image, 0, rejected())[size // 2], o.overlay(image, 0, rejected(long))[size // 2])


def test_both_outcomes_can_be_told_by_their_colour():
    assert strip(o.overlay(GREY, 0, found(), VIEWS), o.GOOD)[0].min() < 20
    assert len(strip(o.overlay(GREY, 0, rejected(), VIEWS), o.GOOD)[0]) == 0


def test_the_inset_keeps_clear_of_the_device():
    assert o.free_corner(np.array([[0.1, 0.9], [0.9, 0.9], [0.1, 0.1]]), 0.25) == (1, 0)
    picture = o.overlay(GREY, 0, found(), VIEWS)
    side = round(o.INSET * SIZE)
    rows, columns = strip(picture, o.TIP)
    corner = rows.max() - rows.min(), (columns < side).sum()
    # its frame is the tip's colour, at the left: the device is at the right
    assert corner[0] > side - 5 and corner[1] > 3 * side


@pytest.mark.parametrize('shape', [(1, 1), (3, 300), (300, 5), (40, 40)])
def test_any_size(shape):
    image = np.zeros(shape, np.uint16)
    for result in (rejected(), found()):
        assert o.overlay(image, 0, result, VIEWS).shape == (*shape, 3)
        assert o.overlay(image, 1, result).shape == (*shape, 3)


def test_points_behind_the_source_do_no_harm():
    shape = replace(straight(), points=straight().points - (0, 0, 1))       # in the source's plane
    assert o.overlay(GREY, 0, found(shape), VIEWS).shape == (SIZE, SIZE, 3)


def test_the_image_is_not_drawn_on():
    image = GREY.copy()
    image.setflags(write=False)
    o.overlay(image, 0, found(), VIEWS)
    assert (image == 100).all()
