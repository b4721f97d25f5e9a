"""A spline fitted to rendered X-ray pairs with known truth: where it lies, where it ends, and what it knows of its
errors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from fluoro_shape_ros.data import Frame
from fluoro_shape_ros.device import load_device
from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.geometry.spline import through
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.strips import Sheet
from fluoro_shape_ros.method.fit.ends import End
from fluoro_shape_ros.method.fit.extent import _confirmed
from fluoro_shape_ros.method.fit.fit import _Surroundings, fit
from fluoro_shape_ros.method.fit.solver import ABRUPT, Layout
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run
from fluoro_shape_ros.sim.xray import Exposure, transmission

PX = 0.3e-3
VIEWS = biplane(arm=CArm(pixel_size_iso=PX, width=512, height=512))
EXPOSURE = Exposure(photons=1500.0)
STEP = 1e-4             # m between the points of a true backbone


def root(frame):
    """Square roots of the counts, and the fields, as the pipeline hands them on."""
    return [np.sqrt(i.astype(np.float32)) for i in frame.images], [field_of_view(i) for i in frame.images]


def fitted(frame, start, radius=0.0006):
    return fit(Sheet.of(*root(frame), VIEWS), start, radius)


def nearest(points, truth):
    """(N, 3) from the closest points of the true curve to (N, 3) points, to 5 um."""
    true = at_arc_length(truth, np.arange(0, arc_length(truth)[-1], 5e-6))
    return points - true[cKDTree(true).query(points)[1]]


def off(f, truth):
    """(N,) m from points along the fit to the true curve."""
    return np.linalg.norm(nearest(f.spline(np.linspace(f.start, f.stop, 300)), truth), axis=1)


def ends(f):
    return f.spline(np.array([f.start, f.stop]))


@pytest.fixture(scope='module')
def run():
    return xray_run(0, views=VIEWS, lengths=(0.06, 0.07), anatomy=False)


@pytest.fixture(scope='module')
def truth(run):
    return run.backbone()


@pytest.fixture(scope='module')
def frame(run):
    return run.scene().frame


@pytest.mark.parametrize('off_px', [(0, 0, 0), (3, 0, 0), (0, 3, 0), (0, 0, -3), (-1.7, 1.7, 1.7)])
def test_from_a_start_px_off_it_settles_on_the_device(frame, truth, off_px):
    f = fitted(frame, truth + np.array(off_px) * PX)
    assert off(f, truth).mean() < 0.05e-3 and off(f, truth).max() < 0.2e-3
    assert np.linalg.norm(ends(f) - truth[[0, -1]], axis=1).max() < 0.25e-3
    assert abs(arc_length(f.spline(np.linspace(f.start, f.stop, 500)))[-1] - arc_length(truth)[-1]) < 0.25e-3
    assert not f.open_end.any()
    assert np.nanmax(np.abs(f.beyond)) < 0.2
    assert np.nanmedian(np.abs(f.offset_px), axis=0).max() < 0.3


def test_what_it_says_of_the_device(frame, truth):
    f = fitted(frame, truth)
    assert f.power > 0.7        # translucent: darker where the rays go a longer way through it
    between = (f.s > f.start) & (f.s < f.stop)
    assert (f.presence[between] > 0.4).mean(axis=0).min() > 0.97
    inside = (f.s > f.start + 5 * PX) & (f.s < f.stop - 5 * PX)
    outside = (f.s < f.start - 5 * PX) | (f.s > f.stop + 5 * PX)
    assert_allclose(np.median(f.presence[inside], axis=0), 1, atol=0.1)
    assert_allclose(np.median(f.presence[outside], axis=0), 0, atol=0.15)


def test_a_start_that_runs_the_other_way_gives_the_same_curve(frame, truth):
    there, back = (fitted(frame, points) for points in (truth, truth[::-1]))
    assert_allclose(ends(there), ends(back)[::-1], atol=0.05e-3)
    u = np.linspace(there.start, there.stop, 100)
    assert np.linalg.norm(nearest(there.spline(u), back.spline(np.linspace(back.start, back.stop, 3000))),
                          axis=1).max() < 0.02e-3


@pytest.mark.parametrize('lost', [0.004, 0.012, 0.025])
@pytest.mark.parametrize('end', ['first', 'last'])
def test_a_start_that_is_too_short_grows_to_the_end(frame, truth, end, lost):
    n = round(lost / STEP)
    f = fitted(frame, truth[n:] if end == 'first' else truth[:-n])
    assert_allclose(ends(f), truth[[0, -1]], atol=0.25e-3)
    assert off(f, truth).mean() < 0.05e-3


def photographed(points, lines=()):
    """A frame of a device of 0.6 mm radius along (N, 3) points, and of `lines`, (M, 3) points and whether each plane
    shows them."""
    images = []
    for k, view in enumerate(VIEWS):
        light = transmission(points, 0.0006, view, EXPOSURE)
        for line, shown_in in lines:
            light = light * (transmission(line, 0.0006, view, EXPOSURE) if shown_in[k] else 1.0)
        counts = np.random.default_rng(k).poisson(EXPOSURE.photons * cv2.GaussianBlur(light, (0, 0), 0.8))
        images.append((counts / EXPOSURE.photons * 180).clip(0, 255).astype(np.uint8))
    return Frame(0, 'isocenter', tuple(images), VIEWS)


def bent(turn_deg, over=0.006, after=0.02):
    """(N, 3) m, a step each: 40 mm straight, turned by `turn_deg` over `over` m, `after` m straight."""
    s = np.arange(round((0.04 + over + after) / STEP)) * STEP
    heading = np.deg2rad(turn_deg) * np.clip((s - 0.04) / over, 0, 1)
    across = np.array([0.6, 0.8, 0.0])
    steps = np.cos(heading)[:, None] * np.array([0.0, 0.2, 0.98]) + np.sin(heading)[:, None] * across
    return np.array([-0.01, -0.01, -0.03]) + np.cumsum(STEP * steps, axis=0)


@pytest.mark.parametrize('turn_deg, start', [(30, 410), (40, 410), (50, 440)])
def test_a_device_that_turns_aside_where_the_start_ends_is_followed(turn_deg, start):
    truth = bent(turn_deg)
    f = fitted(photographed(truth), truth[:start])
    for _ in range(3):
        f = f if f.bent is None else fitted(photographed(truth), f.bent)
    assert_allclose(ends(f), truth[[0, -1]], atol=0.3e-3)
    assert off(f, truth).mean() < 0.1e-3


def test_a_hook_is_followed_arc_by_arc():
    truth = bent(150, over=0.018, after=0.001)
    frame, f = photographed(truth), None
    f = fitted(frame, truth[:380])
    assert f.bent is not None and np.linalg.norm(nearest(f.bent, truth), axis=1).max() < 0.6e-3
    lengths = [f.stop - f.start]
    while f.bent is not None and len(lengths) < 5:
        f = fitted(frame, f.bent)
        lengths.append(f.stop - f.start)
    assert f.bent is None and (np.diff(lengths) > 0).all()
    assert_allclose(ends(f), truth[[0, -1]], atol=0.3e-3)
    assert off(f, truth).mean() < 0.1e-3


@pytest.mark.parametrize('shown_in', [(True, False), (False, True)])
def test_what_one_plane_alone_shows_beside_an_end_is_no_bend(shown_in):
    truth = bent(0, after=0.0)
    hooked = bent(150, over=0.018, after=0.001)
    f = fitted(photographed(truth, [(hooked[len(truth) + 10:], shown_in)]), truth)
    assert f.bent is None
    assert_allclose(ends(f), truth[[0, -1]], atol=0.4e-3)


def test_a_band_beyond_a_pale_stretch_that_bends_says_that_it_goes_on():
    """4 mm that are not seen, then 3 mm that are, on an arc of 10 mm."""
    whole = bent(60, over=0.0105, after=0.0)
    seen, pale = 40e-3 + 3.5e-3, 4e-3
    device, band = whole[:round(seen / STEP)], whole[round((seen + pale) / STEP):]
    f = fitted(photographed(device, [(band, (True, True))]), device)
    assert f.farther[0] < 1 and f.farther[1] > 5
    assert f.bent is not None and np.linalg.norm(nearest(f.bent[:-1], whole), axis=1).max() < 0.6e-3
    assert np.linalg.norm(f.bent[-1] - whole[-1]) < 1.5e-3
    assert fitted(photographed(device), device).farther.max() < 1


@pytest.mark.parametrize('white, expected', [
    (True, [36, 9]),        # noise: a window four times as long is twice as clear
    (False, [9, 9]),        # anatomy that is alike over as many px: it shows nothing more
])
def test_a_faint_device_is_averaged_longer_where_that_helps(white, expected):
    s = np.linspace(0, 0.1, 50)

    def over(px):
        return np.full((2, 50), 3.0) / np.sqrt(px / 9 if white else np.ones(2))[:, None]

    around = _Surroundings(s, over, over(np.array([9, 9])))
    clutter, px = around.along(s, np.array([[7.5], [60.0]]) + 0 * s, np.ones(50, bool))     # 2.5 and 20 times that
    assert px.tolist() == expected
    assert_allclose(clutter, over(px))


def hidden_in_one(slant, plane, turn_deg=20):
    """A fit of a device whose end a line hides in one plane, and the device's ends."""
    truth = bent(turn_deg)
    tangent = (truth[-1] - truth[-50]) / np.linalg.norm(truth[-1] - truth[-50])
    aside = np.cross(tangent, [1.0, 0.0, 0.0])
    lead = truth[-1] + np.linspace(-0.03, 0.03, 300)[:, None] * (aside / np.linalg.norm(aside) + slant * tangent)
    return fitted(photographed(truth, [(lead, (plane == 0, plane == 1))]), truth), truth[[0, -1]]


def test_an_end_that_another_line_hides_in_one_plane_is_where_the_other_shows_it():
    f, truth = hidden_in_one(1.5, 1)
    assert f.alone.tolist() == [-1, 0]
    assert_allclose(ends(f), truth, atol=0.3e-3)
    assert 0.2e-3 < f.end_sigma[1] < 0.35e-3


def test_ends_that_lines_of_any_slant_hide_in_one_plane_are_mostly_found():
    """Lines that cross right at the end and are twice as dark; of 78 such ends 57 were within 0.3 mm."""
    off = []
    for slant in np.arange(-1.8, 1.9, 0.6):
        for plane in (0, 1):
            f, truth = hidden_in_one(slant, plane)
            off.append(np.abs(ends(f) - truth).max())
            assert off[-1] < 10 * f.end_sigma[1]
    assert np.mean(np.array(off) < 0.3e-3) >= 0.6 and np.median(off) < 0.25e-3


def test_a_start_that_is_too_long_shrinks_to_the_end(frame, truth):
    step = truth[-1] - truth[-2]
    f = fitted(frame, np.concatenate([truth, truth[-1] + np.arange(1, 80)[:, None] * step]))
    assert_allclose(ends(f), truth[[0, -1]], atol=0.25e-3)


def test_the_device_runs_out_of_the_field():
    scene = xray_run(3, views=VIEWS, lengths=(0.05, 0.06), anatomy=False, entering=True).scene()
    f = fitted(scene.frame, scene.truth)
    assert f.open_end.tolist() == [True, False]
    assert np.linalg.norm(ends(f)[1] - scene.truth[-1]) < 0.25e-3
    assert off(f, scene.truth).mean() < 0.05e-3


def test_what_bends_abruptly_is_pulled_no_harder_than_what_bends_a_little_less():
    x = np.linspace(0, 0.1, 400)[:, None]
    even, hooked = (through(np.hstack([x, k * np.maximum(x - 0.05, 0), 0 * x]), 0.0) for k in (1e-4, 3.0))
    for spline, abrupt in ((even, False), (hooked, True)):
        layout = Layout.of(spline, 1e-3)
        prior, pull = layout.stiff(spline)
        uneven = layout.bends @ spline.control
        size = np.linalg.norm(uneven, axis=1)
        assert (size > ABRUPT).any() == abrupt
        let = uneven * np.minimum(1, ABRUPT / size)[:, None]
        assert_allclose(pull, -(layout.bends.T @ let).ravel(), rtol=1e-9, atol=1e-9)
        # along each axis: what speaks against a step of one control point is the square of its share of the bends
        weights = np.minimum(1, ABRUPT / size)
        assert_allclose((prior - layout.prior)[0, ::3], (weights[:, None] * layout.bends**2).sum(axis=0), rtol=1e-9)


def test_another_line_that_crosses_does_not_pull(run, truth):
    frame = run.scene().frame
    images = [i.copy() for i in frame.images]
    for image in images:
        image[:, 240:260] = (image[:, 240:260] * 0.8).astype(np.uint8)         # a wide, weaker band: a rib
    f = fitted(replace(frame, images=tuple(images)), truth + 0.5 * PX)
    assert off(f, truth).mean() < 0.06e-3


def across(f, u):
    """(K, 2, 3) two unit vectors across the curve at (K,) arc lengths."""
    tangent = f.spline(u, 1)
    return np.stack([np.linalg.svd(t[None])[2][1:] for t in tangent])


def lateral(f, u, N):
    """(K, 2, 2) m^2: covariance of the curve's points along the (K, 2, 3) vectors."""
    B, n = f.spline.bases(u, 0)[0], len(f.spline.control)
    return N @ np.einsum('in,namb,im->iab', B, f.covariance.reshape(n, 3, n, 3), B) @ N.transpose(0, 2, 1)


def test_the_covariance_is_that_of_the_scatter_over_noise(run, truth):
    square, along = [], []
    for k in range(12):
        f = fitted(run.scene(index=k).frame, truth + [PX, -PX, PX])
        u = np.linspace(f.start, f.stop, 7)[1:-1]
        N = across(f, u)
        x = np.einsum('kij,kj->ki', N, nearest(f.spline(u), truth))
        square += np.einsum('ki,kij,kj->k', x, np.linalg.inv(lateral(f, u, N)), x).tolist()
        tangent = f.spline(np.array([f.start, f.stop]), 1)
        along.append(np.einsum('ki,ki->k', ends(f) - truth[[0, -1]], tangent)
                     / np.linalg.norm(tangent, axis=1) / f.end_sigma)
    # two degrees of freedom each; neighbours share errors, and what the model is worth does not scatter: not far above
    # 1, not near 0
    assert 0.2 < np.mean(square) / 2 < 1.6
    assert np.mean(np.array(square) < 5.99) > 0.9       # chi square, 95 %
    assert 0.1 < np.mean(np.square(along)) < 2.0
    assert np.mean(np.abs(along) < 1.96) > 0.85


def worst_variances(f):
    """(3,) m^2 across the curve, in the worse direction, at three places."""
    u = np.array([0.02, 0.03, 0.04])
    return np.linalg.eigvalsh(lateral(f, u, across(f, u)))[:, 1]


def test_ends_that_the_planes_see_at_one_place_tell_the_depth(frame, truth):
    f = fitted(frame, truth)
    f = replace(f, covariance=1e-6 * np.eye(f.spline.control.size))
    basis, slope = (f.spline.bases(np.array([f.stop]), k)[0][0] for k in (0, 1))
    X, T = basis @ f.spline.control, slope @ f.spline.control
    steps = []      # m along the curve by which each plane sees the end move, per m of the end's own step
    for v in VIEWS:
        move = lambda d: project(v.P, X + d) - project(v.P, X)      # noqa: B023, E731
        along = move(1e-6 * T) / 1e-6
        steps.append([along @ move(d) / 1e-6 / (along @ along) for d in 1e-6 * np.eye(3)])
    row = (basis[:, None] * np.subtract(*steps)).ravel()
    known = 1e-6 * row @ row
    sigma = 0.5 * np.sqrt(known)
    end = lambda apart: End(f.stop, sigma, f.stop + np.array([0, apart]), np.full(2, sigma / np.sqrt(2)))   # noqa: E731
    told = _confirmed(f, [None, end(0.5 * sigma)], VIEWS)
    assert_allclose(row @ told @ row, known * sigma**2 / (known + sigma**2), rtol=1e-3)
    assert _confirmed(f, [None, end(2 * sigma)], VIEWS) is f.covariance      # one of them may be another edge
    assert _confirmed(f, [None, None], VIEWS) is f.covariance


def test_less_dose_is_known_less_well(run, truth, frame):
    # ten times the variance, less what the model is worth
    dim = replace(run, exposure=Exposure(photons=150)).scene().frame
    assert (worst_variances(fitted(dim, truth)) > 2 * worst_variances(fitted(frame, truth))).all()


def test_depth_is_known_less_well_between_planes_that_nearly_agree(frame, truth):
    narrow = biplane(angle_b=(np.deg2rad(35), 0.0), arm=CArm(pixel_size_iso=PX, width=512, height=512))
    run = xray_run(0, views=narrow, lengths=(0.06, 0.07), anatomy=False)
    f = fit(Sheet.of(*root(run.scene().frame), narrow), run.backbone(), run.radius)
    assert off(f, run.backbone()).mean() < 0.1e-3
    assert worst_variances(f).mean() > 1.5 * worst_variances(fitted(frame, truth)).mean()


def test_nothing_is_fitted_where_both_fields_are_dark(frame, truth):
    images, _ = root(frame)
    assert fit(Sheet.of(images, [np.zeros((512, 512), np.uint8)] * 2, VIEWS), truth, 0.0006) is None


@pytest.mark.parametrize('start', ['at a source', 'behind it', 'out and back'])
def test_nothing_is_fitted_from_a_start_that_no_device_can_have(frame, truth, start):
    there = source(VIEWS[0].P)
    if start == 'at a source':
        points = there * 0.999 + 0.01 * (truth - truth.mean(axis=0))
    elif start == 'behind it':
        points = truth + 1.5 * there
    else:
        points = np.tile(np.concatenate([truth, truth[::-1]]), (20, 1))
    assert fitted(frame, points) is None


@pytest.mark.parametrize('kind', ['ep', 'coil', 'braided'])
def test_a_start_anywhere_gives_no_fit_or_a_finite_one(kind):
    """Far from the device, across it, and much too short."""
    scene = xray_run(0, views=VIEWS, lengths=(0.06, 0.07), anatomy=False, device=load_device(kind)).scene()
    middle_of = scene.truth[len(scene.truth) // 2]
    for points in (scene.truth[::-1][:20], middle_of + np.linspace(-0.03, 0.03, 60)[:, None] * [0.3, 0.9, 0.1],
                   scene.truth + 0.004, scene.truth[30:60]):
        f = fitted(scene.frame, points)
        assert f is None or np.isfinite([f.start, f.stop, *f.end_sigma, *f.farther]).all()
