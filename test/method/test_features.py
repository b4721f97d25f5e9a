"""What the images say of a fit: the same on any display, from either side, in either order; worse where the fit is."""

from dataclasses import fields, replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.geometry.curve import arc_length, resample
from fluoro_shape_ros.geometry.spline import through
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.prepare import sheet_of
from fluoro_shape_ros.method.features import NAMES, Features, at_first_sight, features
from fluoro_shape_ros.method.fit.fit import fit
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.xray import Exposure

SIZE = 512
VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=SIZE, height=SIZE))
PX = 0.3e-3
DIAGONAL_PX = SIZE * np.sqrt(2)
ROUNDING = 0.01        # OpenCV 4 interpolates at places rounded to 1/32 px
LITTLE = 0.1    # what a display's offset may change: the square root of counts no longer makes their noise quite even


@cache
def run(anatomy):
    return xray_run(0, views=VIEWS, lengths=(0.06, 0.07), anatomy=anatomy)


@cache
def scene(anatomy):
    return run(anatomy).scene()


def fitted(images, views=VIEWS, anatomy=False, way=1):
    """A pair's sheet, and the fit from the true curve."""
    sheet = sheet_of(images, [field_of_view(i) for i in images], views, 'dark')
    return sheet, fit(sheet, scene(anatomy).truth[::way], run(anatomy).radius)


@cache
def known(anatomy=False):
    return fitted(scene(anatomy).frame.images, anatomy=anatomy)


def named(f, sheet, tip_is_last=True):
    return dict(zip(NAMES, features(f, sheet, run(False).radius, tip_is_last)))


def assert_same(found, expected, atol, names=NAMES):
    assert_allclose([found[n] for n in names], [expected[n] for n in names], atol=atol, err_msg=', '.join(names))


def expected(anatomy=False):
    sheet, f = known(anatomy)
    return named(f, sheet)


def test_there_is_a_finite_number_for_every_name():
    assert NAMES == tuple(x.name for x in fields(Features))
    for anatomy in (False, True):
        assert len(expected(anatomy)) == len(NAMES) and np.isfinite(list(expected(anatomy).values())).all()


@pytest.mark.parametrize('anatomy', [False, True])
@pytest.mark.parametrize('planes', [(0,), (1,), (0, 1)])
@pytest.mark.parametrize('change, atol', [(lambda i: 0.5 * i.astype(np.float32), 0.02),
                                          (lambda i: i.astype(np.uint16) * 200, 0.02),
                                          (lambda i: 0.5 * i.astype(np.float32) + 40, LITTLE),
                                          (lambda i: i.astype(np.float32) + 40, LITTLE)],
                         ids=['gain', '16 bit', 'gain and offset', 'offset'])
def test_gain_and_offset_of_either_display_tell_nothing(anatomy, planes, change, atol):
    images = [change(i) if k in planes else i for k, i in enumerate(scene(anatomy).frame.images)]
    sheet, f = fitted(images, anatomy=anatomy)
    apart = ['tip_apart', 'base_apart']         # of some 2 px here, each plane's end to a tenth of that
    assert_same(named(f, sheet), expected(anatomy), atol, [n for n in NAMES if n not in apart])
    assert_same(named(f, sheet), expected(anatomy), 2 * atol, apart)


@pytest.mark.parametrize('anatomy', [False, True])
def test_exchanged_planes_say_the_same(anatomy):
    sheet, f = fitted(scene(anatomy).frame.images[::-1], VIEWS[::-1], anatomy)
    assert_same(named(f, sheet), expected(anatomy), ROUNDING)


@pytest.mark.parametrize('anatomy', [False, True])
@pytest.mark.parametrize('plane, axis', [(0, 1), (1, 1), (1, 0)])
def test_a_mirrored_plane_says_the_same(anatomy, plane, axis):
    flip = np.eye(3)
    flip[1 - axis, 1 - axis], flip[1 - axis, 2] = -1, SIZE - 1
    images = [np.flip(i, axis).copy() if k == plane else i for k, i in enumerate(scene(anatomy).frame.images)]
    views = [replace(v, P=flip @ v.P) if k == plane else v for k, v in enumerate(VIEWS)]
    sheet, f = fitted(images, views, anatomy)
    assert_same(named(f, sheet), expected(anatomy), ROUNDING)


def test_a_curve_that_runs_the_other_way_says_nearly_the_same():
    sheet, f = fitted(scene(False).frame.images, way=-1)
    assert_same(named(f, sheet, tip_is_last=False), expected(), LITTLE)     # its strips lie elsewhere by parts of a px


def test_which_end_is_the_tip_exchanges_what_is_said_of_the_ends():
    sheet, f = known(True)
    f = replace(f, aside=np.array([[0.1, 0.2], [0.7, 0.3]]), open_end=np.array([False, False]))
    one, other = named(f, sheet, True), named(f, sheet, False)
    assert_allclose([one['tip_aside']**2, other['tip_aside']**2], [0.7 * 0.3, 0.1 * 0.2])
    alone = replace(f, aside=np.array([[0.0, 1.0], [1.0, 0.0]]))    # what only one plane shows is another line
    assert named(alone, sheet, True)['tip_aside'] == named(alone, sheet, False)['tip_aside'] == 0
    assert one['tip_stops'] != other['tip_stops']
    assert one['base_stops'] == other['tip_stops'] and other['base_stops'] == one['tip_stops']
    # of the tip, what lies across counts, too
    assert one['base_sigma'] < other['tip_sigma'] and other['base_sigma'] < one['tip_sigma']
    assert_same(one, other, 0, [n for n in NAMES if not n.startswith(('tip', 'base'))])


def test_a_quarter_of_the_dose_halves_the_signal_to_noise():
    images = replace(run(False), exposure=Exposure(photons=Exposure().photons / 4)).scene().frame.images
    sheet, f = fitted(images)
    dim, clear = named(f, sheet), expected()
    # the spread of some hundred places is known to a tenth
    assert_allclose(clear['weakest'] - dim['weakest'], np.log(2), atol=0.25)
    assert (dim['residual'] > clear['residual'] and dim['sigma'] > clear['sigma']
            and dim['tip_sigma'] > clear['tip_sigma'])


def aside(f, px, plane=0):
    """The fit moved so that `plane` shows it so many px beside."""
    chord, middle = np.diff(f.curve(2), axis=0)[0], f.curve(3)[1]
    ray = np.linalg.inv(VIEWS[plane].P[:, :3]) @ np.append(project(VIEWS[plane].P, middle[None])[0], 1)
    step = np.cross(chord, ray) / np.linalg.norm(np.cross(chord, ray))
    return replace(f, spline=replace(f.spline, control=f.spline.control + px * PX * step))


@pytest.mark.parametrize('anatomy', [False, True])
@pytest.mark.parametrize('plane', [0, 1])
@pytest.mark.parametrize('px', [-3, 3])
def test_a_curve_beside_the_device_has_one_side_darker(anatomy, plane, px):
    sheet, f = known(anatomy)
    beside = named(aside(f, px, plane), sheet)
    assert beside['symmetric'] > expected(anatomy)['symmetric'] + 0.5


def test_along_an_edge_one_side_is_darker():
    straight = np.c_[np.zeros((200, 2)), np.linspace(-0.03, 0.03, 200)]       # one column in both planes
    columns = [float(project(v.P, straight)[100, 0]) for v in VIEWS]
    images = [np.where(np.arange(SIZE) < c, 200, 120).astype(np.uint8)[None].repeat(SIZE, axis=0) for c in columns]
    sheet, _ = known()
    f = by_hand(straight)
    edge, device = named(f, sheet_of(images, sheet.fields, VIEWS, 'dark')), expected()
    assert edge['symmetric'] > 0.9 > 0.1 > device['symmetric']


def by_hand(points):
    """A fit that lies along (N, 3) points in m and comes from no image."""
    _, f = known()
    spline = through(points, 0.005)
    s = np.arange(spline.start, spline.stop, PX)
    return replace(f, spline=spline, start=0.0, stop=float(arc_length(points)[-1]), s=s, presence=np.ones((len(s), 2)),
                   offset_px=np.zeros((len(s), 2)), covariance=np.zeros((spline.control.size,) * 2))


def test_arcs_are_even_and_what_leaves_one_line_for_another_is_not():
    sheet, _ = known()
    t = np.linspace(0, 1.2, 400)
    arc = 0.05 * np.c_[np.sin(t), np.zeros(len(t)), 1 - np.cos(t)]
    jogged = arc + np.c_[np.zeros(400), 2e-3 / (1 + np.exp(-(t - 0.6) / 0.02)), np.zeros(400)]      # by 2 mm
    assert named(by_hand(arc), sheet)['uneven'] == 0 and named(by_hand(jogged), sheet)['uneven'] > 1


def test_a_tip_known_badly_across_is_as_uncertain_as_one_known_badly_along():
    sheet, f = known()
    n, basis = len(f.spline.control), f.spline.bases(np.array([f.stop]), 0)[0][0]
    across = replace(f, end_sigma=np.zeros(2), covariance=np.kron(np.eye(n), np.diag([1e-6, 0, 0])) / (basis @ basis))
    along = replace(f, end_sigma=np.full(2, 1e-3), covariance=np.zeros((3 * n, 3 * n)))
    assert_allclose([named(x, sheet)['tip_sigma'] for x in (across, along)], 0, atol=1e-9)     # 1 mm each
    assert named(across, sheet)['base_sigma'] < named(along, sheet)['base_sigma'] == 0


def test_what_the_fit_left_over_is_its_rms_in_the_worse_plane():
    sheet, f = known()
    left = np.zeros_like(f.offset_px)
    assert named(replace(f, offset_px=left), sheet)['residual'] == 0
    assert_allclose(named(replace(f, offset_px=left + [0.4, -1.2]), sheet)['residual'], 1.2)
    every_second = np.where(np.arange(len(f.s))[:, None] % 2, 1.0, np.nan)
    assert_allclose(named(replace(f, offset_px=left + every_second), sheet)['residual'], 1.0)
    noise = np.where(np.arange(len(f.s))[:, None] % 2, 2.0, -2.0)                   # averages out
    assert named(replace(f, offset_px=left + noise), sheet)['residual'] == 0
    assert (named(replace(f, offset_px=left + np.nan), sheet)['residual']
            == named(replace(f, offset_px=left + 9.0), sheet)['residual'] == 3.0)


@pytest.mark.parametrize('anatomy', [False, True])
@pytest.mark.parametrize('share', [0.5, 0.9])
def test_a_curve_that_is_cut_short_is_seen_to_go_on(anatomy, share):
    sheet, f = known(anatomy)
    whole, step = expected(anatomy), share * (f.stop - f.start)
    no_tip, no_base = (named(replace(f, **cut), sheet)
                       for cut in (dict(stop=f.start + step), dict(start=f.stop - step)))
    # what its base does says nothing
    assert whole['tip_stops'] > 0.6 > 0.25 > no_tip['tip_stops'] and no_base['tip_stops'] > 0.5
    assert_allclose([no_tip['length'], no_base['length']], whole['length'] + np.log(share), atol=0.02)


@pytest.mark.parametrize('anatomy', [False, True])
def test_a_curve_that_is_too_long_is_not_shown_there(anatomy):
    sheet, f = known(anatomy)
    whole, longer = expected(anatomy), named(replace(f, stop=f.stop + 20 * (f.s[1] - f.s[0])), sheet)
    assert longer['tip_stops'] < 0.3 < 0.6 < whole['tip_stops']


@pytest.mark.parametrize('plane', [0, 1])
def test_what_one_plane_does_not_show_is_a_share_of_the_blocks(plane):
    _, f = known()
    there, gone = scene(False).frame.images, run(False).without_device().images
    uv = project(VIEWS[plane].P, f.curve(3))[:, 0]
    hidden = there[plane].copy()
    far = slice(None, int(uv[1])) if uv[0] < uv[1] else slice(int(uv[1]) + 1, None)        # the base's half
    hidden[:, far] = gone[plane][:, far]
    sheet = sheet_of([hidden if k == plane else i for k, i in enumerate(there)], [field_of_view(i) for i in there],
                     VIEWS, 'dark')
    half, whole = named(f, sheet), expected()
    assert_allclose(half['seen'], 0.5, atol=0.15)
    assert half['weakest'] < whole['weakest'] - 1


def test_where_it_leaves_the_field_an_end_says_nothing_against_it():
    sheet, f = known()
    f = replace(f, start=f.start + 0.01, stop=f.stop - 0.01, aside=np.zeros((2, 2)))
    leaves = named(replace(f, open_end=np.array([False, True])), sheet)
    assert leaves['tip_stops'] == 1 and named(f, sheet)['tip_stops'] < 0.5


def test_an_end_of_a_paler_part_stops_as_much_as_any():
    """The tip's half is half as dark: it stops by all of what it is."""
    images, gone = scene(False).frame.images, run(False).without_device().images
    sheet, f = known()
    paler = []
    for k, (image, without) in enumerate(zip(images, gone)):
        far = np.full(image.shape, 255, np.uint8)
        far[tuple(np.rint(project(VIEWS[k].P, f.curve(400))[200:, ::-1]).astype(int).T)] = 0
        near = cv2.distanceTransform(far, cv2.DIST_L2, 5) < 12
        paler.append(np.where(near, (image.astype(float) + without) / 2, image).astype(image.dtype))
    paler = named(f, sheet_of(paler, [field_of_view(i) for i in paler], VIEWS, 'dark'))
    assert_allclose(paler['tip_stops'], expected()['tip_stops'], atol=0.15)


def test_the_shape_by_hand():
    """A length is a share of the diagonal, along an arc too."""
    sheet, f = known()
    angle = np.linspace(-0.6, 0.6, 300)
    arc = 0.04 * np.c_[np.zeros(300), np.sin(angle), np.cos(angle) - 1]
    turned, straight = (named(by_hand(resample(arc, PX)[0]), sheet),
                        named(by_hand(np.c_[np.zeros((200, 2)), np.linspace(-0.03, 0.03, 200)]), sheet))
    assert_allclose([turned['length'], straight['length']], np.log(np.array([0.048, 0.06]) / PX / DIAGONAL_PX),
                    atol=0.02)



def test_what_is_handed_on():
    sheet, f = known()
    px = f.s[1] - f.s[0]
    told = named(replace(f, seen_at=np.array([[0, 0], [5, 2]]) * px, seen_sigma=np.array([[3, 4], [0, 4]]) * px,
                         moved_px=0.5), sheet)
    assert_allclose([told['base_apart'], told['tip_apart'], told['restless']], np.log([5, 5, 0.5]))
    by_one = named(replace(f, seen_at=np.full((2, 2), np.nan), seen_sigma=np.full((2, 2), np.nan)), sheet)
    assert np.isnan([by_one['base_apart'], by_one['tip_apart']]).all()
    leaves = named(replace(f, open_end=np.array([True, False])), sheet)
    assert (told['no_base'], leaves['no_base'], leaves['no_tip']) == (0, 1, 0)
    twice = named(replace(f, end_sigma=2 * f.end_sigma, covariance=4 * f.covariance), sheet)
    assert_allclose([twice[n] - expected()[n] for n in ('tip_sigma', 'sigma')], np.log(2))


def test_the_same_fit_says_the_same_again():
    sheet, f = known(True)
    before = sheet.image.copy()
    assert_array_equal(list(named(f, sheet).values()), list(named(f, sheet).values()))
    assert_array_equal(sheet.image, before)


@pytest.mark.parametrize('anatomy', [False, True])
def test_at_first_sight_a_curve_says_about_what_its_fit_does(anatomy):
    sheet, f = known(anatomy)
    sketched = dict(zip(NAMES, at_first_sight(f.curve(100), sheet, run(anatomy).radius)))
    told = [n for n in NAMES if np.isfinite(sketched[n])]
    assert {'weakest', 'seen', 'symmetric', 'wide', 'length'} <= set(told) and not np.isfinite(sketched['tip_sigma'])
    assert_allclose([sketched[n] for n in told], [expected(anatomy)[n] for n in told], atol=0.5)
    beside = dict(zip(NAMES, at_first_sight(f.curve(100) + 0.004, sheet, run(anatomy).radius)))
    assert beside['weakest'] < sketched['weakest'] - 1


def test_a_curve_that_goes_to_a_source_is_not_seen():
    sheet, f = known()
    towards = np.linspace(f.curve(2)[0], sources()[0], 50)
    sight = dict(zip(NAMES, at_first_sight(towards, sheet, run(False).radius)))
    assert sight['seen'] == 0 and np.isnan(sight['length'])


def sources():
    return [source(v.P) for v in VIEWS]
