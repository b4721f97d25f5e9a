"""Both renderers against lengths worked out by hand, against the projected truth, and against each other."""

import cv2
import numpy as np
import pytest

from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.geometry.curve import arc_length
from fluoro_shape_ros.sim import carm, shapes, vtk_scene, xray

FINE = carm.biplane(arm=carm.CArm(pixel_size_iso=0.2e-3, width=400, height=300))
ODD = carm.biplane((0.35, -0.26), (1.4, 0.3), carm.CArm(sid=1.0, sod=0.7, pixel_size_iso=0.4e-3, width=480, height=400))
RADIUS = 0.0012


@pytest.fixture(scope='module')
def vtk():
    """VTK, and something that it can draw with."""
    pytest.importorskip('vtkmodules.vtkRenderingOpenGL2')
    try:
        vtk_scene.coverage(rod((1, 0, 0)), RADIUS, FINE[0])
    except vtk_scene.NoOpenGL as error:
        pytest.skip(str(error))


def rod(direction, length=0.03, centre=(0, 0, 0)):
    """A straight backbone."""
    direction = np.array(direction, float) / np.linalg.norm(direction)
    return np.array(centre) + (np.arange(-length / 2, length / 2 + 1e-9, 1e-4)[:, None]) * direction


def offsets(shadow, truth, view, ends=30):
    """Distances in px of the shadow's centroid across the projected truth, along it but for its ends."""
    uv = project(view.P, truth)
    along = np.gradient(uv, axis=0)
    across = np.c_[-along[:, 1], along[:, 0]] / np.linalg.norm(along, axis=1, keepdims=True)
    uv, across = uv[ends:-ends:7], across[ends:-ends:7]
    reach = np.arange(-8, 8.01, 0.1)
    at = (uv[:, None] + reach[:, None] * across[:, None]).astype(np.float32)
    profile = cv2.remap(shadow, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    assert profile.max(axis=1).min() > 0
    return (profile * reach).sum(axis=1) / profile.sum(axis=1)


def blurred(shadow):
    return cv2.GaussianBlur(shadow, (5, 5), 0)


def robot(seed):
    """A gently bent robot well inside any of the fields, across the beams."""
    bends = np.random.default_rng(seed).normal(0, 0.25, (5, 2))
    heading = np.array([[0.2, 0.9, 0], [0.2, -0.4, 0], [-1.0, 0, 0]])
    heading[:, 0] /= np.linalg.norm(heading[:, 0])
    heading[:, 2] = np.cross(heading[:, 0], [1.0, 0, 0]) / np.linalg.norm(np.cross(heading[:, 0], [1.0, 0, 0]))
    heading[:, 1] = np.cross(heading[:, 2], heading[:, 0])
    return shapes.Spline(0.04, bends, shapes.Pose(-0.02 * heading[:, 0], heading)).backbone()


@pytest.mark.parametrize('view', [*FINE, *ODD])
@pytest.mark.parametrize('seed', [1, 2])
def test_centrelines_agree_with_truth_and_each_other(vtk, seed, view):
    backbone = robot(seed)
    tube = offsets(blurred(vtk_scene.coverage(backbone, 0.0006, view)), backbone, view)
    rays = offsets(blurred(xray.path_length(backbone, 0.0006, view)), backbone, view)
    assert np.abs(tube).max() < 0.05
    assert np.abs(rays).max() < 0.05
    assert np.abs(tube - rays).max() < 0.05
    assert abs(tube.mean()) < 0.01 and abs(rays.mean()) < 0.01


@pytest.mark.parametrize('angle_deg', [90, 60, 30])
def test_path_through_the_axis(angle_deg):
    """2 r / sin(angle between device and ray); the pixel of 0.2 mm is 1/12 of the tube: its mean over it is 0.2 %
    less."""
    view, angle = FINE[0], np.deg2rad(angle_deg)
    lengths = xray.path_length(rod((np.sin(angle), np.cos(angle), 0)), RADIUS, view)
    at_isocentre = lengths[149:151, 199:201].mean()
    assert at_isocentre == pytest.approx(2 * RADIUS / np.sin(angle), rel=0.02)


def test_volume_is_kept():
    """The sum of path lengths times the pixel's area where the rod stands is its volume."""
    for view in FINE:
        lengths = xray.path_length(rod((0, 0, 1)), RADIUS, view)
        assert lengths.sum() * 0.2e-3**2 == pytest.approx(np.pi * RADIUS**2 * 0.03, rel=2e-3)


def test_crossing_adds_up():
    """A prolate cycloid (a t - b sin t, b cos t) meets itself where a t = b sin t."""
    a, b, t0 = 0.01, 0.02, 1.895494267
    assert a * t0 == pytest.approx(b * np.sin(t0))
    t = np.linspace(-3, 3, 4000)
    loop = np.c_[a * t - b * np.sin(t), 0 * t, b * np.cos(t)]
    lengths = xray.path_length(loop, RADIUS, FINE[0])
    u, v = np.rint(project(FINE[0].P, np.array([0, 0, b * np.cos(t0)]))).astype(int)
    assert lengths[v, u] == pytest.approx(2 * 2 * RADIUS, rel=0.04)
    u, v = np.rint(project(FINE[0].P, np.array([0, 0, b]))).astype(int)     # the loop's top
    assert lengths[v, u] == pytest.approx(2 * RADIUS, rel=0.04)


def test_coverage_is_the_area_of_the_shadow(vtk):
    assert (vtk_scene.coverage(rod((0, 0, 1)), RADIUS, FINE[0]).sum() * 0.2e-3**2
            == pytest.approx(2 * RADIUS * 0.03, rel=0.01))
    middle = vtk_scene.render(rod((0, 0, 1)), RADIUS, FINE[0], device=0.12, background=0.75)[150]
    assert (middle[199:201] == pytest.approx(0.12) and middle[:190] == pytest.approx(0.75)
            and middle[210:] == pytest.approx(0.75))


@pytest.mark.parametrize('out', [(1, 0, 0.2), (-1, 0, 0.2), (0.3, 0, -1)])
def test_ends_are_flat_and_where_they_should_be(vtk, out):
    """Along the axis the shadow falls to a half exactly at the tip; here the tip stands at the isocentre, where its
    face is seen edge-on."""
    view, centre = FINE[0], -np.array(out) / np.linalg.norm(out) * 0.01
    tip, inner = np.array([199.5, 149.5]), project(view.P, centre)
    along = (tip - inner) / np.linalg.norm(tip - inner)
    reach, side = np.arange(-4, 4.01, 0.05), np.arange(-3, 3.01, 0.25)
    at = (tip + reach[:, None, None] * along + side[:, None] * np.array([-along[1], along[0]])).astype(np.float32)
    for shadow in (vtk_scene.coverage(rod(out, 0.02, centre), RADIUS, view),
                   xray.path_length(rod(out, 0.02, centre), RADIUS, view)):
        profile = cv2.remap(shadow, at[..., 0], at[..., 1], cv2.INTER_LINEAR).mean(axis=1)
        assert abs(np.interp(-profile[:20].mean() / 2, -profile, reach)) < 0.05


def test_device_outside_leaves_the_image_alone(vtk):
    beside = rod((0, 0, 1), centre=(0.5, 0, 0))
    assert not vtk_scene.coverage(beside, RADIUS, FINE[0]).any()
    assert not xray.path_length(beside, RADIUS, FINE[0]).any()


def test_half_outside_shows_the_other_half(vtk):
    backbone = rod((1, 0, 0), length=0.06, centre=(-0.04, 0, 0))    # u from 250 to 550 in an image of 400
    for shadow in (vtk_scene.coverage(backbone, RADIUS, FINE[0]) * 2 * RADIUS,
                   xray.path_length(backbone, RADIUS, FINE[0])):
        assert shadow[:, 398].sum() == pytest.approx(shadow[:, 396].sum(), rel=0.02)
        assert shadow[:, 399].max() > 1.9 * RADIUS and not shadow[:, :245].any()


def test_contrast_is_that_of_the_axis():
    exposure = xray.Exposure(contrast=0.3)
    beam = xray.transmission(rod((0, 0, 1)), RADIUS, FINE[0], exposure)
    assert beam[150, 199:201].mean() == pytest.approx(0.7, abs=0.005)
    assert (beam[:, :180] == 1).all()
    # twice the path squares the transmission
    steep = xray.transmission(rod((0, np.cos(np.pi / 6), np.sin(np.pi / 6))), RADIUS, FINE[0], exposure)
    assert steep[149:151, 199:201].mean() == pytest.approx(0.49, abs=0.01)


def test_the_seeds_noise_and_blur():
    grey = np.full((500, 500), 0.5, np.float32)
    noisy = vtk_scene.degrade(grey, np.random.default_rng(3)) / 255
    assert noisy.mean() == pytest.approx(0.5, abs=5e-4)
    assert noisy.var() == pytest.approx(0.002, rel=0.02)
    dot = np.zeros((15, 15), np.float32)
    dot[7, 7] = 1
    spread = vtk_scene.degrade(dot, np.random.default_rng(3), variance=0.0)
    assert spread[5:10, 5:10].all() and spread.sum() == spread[5:10, 5:10].sum()
    assert spread[7, 7] == spread.max() < 0.3 * 255


@pytest.mark.parametrize('photons', [8, 200, 2000])
def test_quantum_noise_is_poisson(photons):
    """Variance = mean, in counts, for few and for many."""
    exposure = xray.Exposure(photons=photons, depth=16, white=0.5, blur_px=0)
    counts = (xray.expose(np.full((400, 400), 0.5, np.float32), exposure, np.random.default_rng(4))
              / (0.5 * 65535) * photons)
    assert counts.mean() == pytest.approx(photons / 2, rel=0.01)
    assert counts.var() == pytest.approx(photons / 2, rel=0.03)


@pytest.mark.parametrize('depth, dtype, full', [(8, np.uint8, 255), (12, np.uint16, 4095), (16, np.uint16, 65535)])
def test_full_scale(depth, dtype, full):
    beam = np.array([[0.0, 0.5, 1.0]], np.float32)
    image = xray.expose(beam, xray.Exposure(depth=depth, white=1.0, blur_px=0), None)
    assert image.dtype == dtype
    assert image.tolist() == [[0, np.rint(full / 2), full]]
    over = xray.expose(np.full((100, 100), 1, np.float32), xray.Exposure(depth=depth, white=1.0),
                       np.random.default_rng(0))
    assert over.max() == full and over.min() > full / 2       # noise above white is cut, and does not wrap


@pytest.mark.parametrize('wrong', [{'contrast': 0.0}, {'contrast': 1.0}, {'photons': 0.0}, {'depth': 17}])
def test_impossible_exposures_are_refused(wrong):
    with pytest.raises(ValueError, match='no exposure'):
        xray.Exposure(**wrong)


def test_a_bend_is_as_thick_as_a_rod():
    """Pappus: a bent tube has the volume of its cross-section times its axis' length, and its shadow is symmetric about
    the axis."""
    t = np.linspace(0, 1.5, 2000)
    bent = 0.02 * np.c_[np.sin(t), 0 * t, 1 - np.cos(t)]
    lengths = xray.path_length(bent, RADIUS, FINE[0])
    assert lengths.sum() * 0.2e-3**2 == pytest.approx(np.pi * RADIUS**2 * arc_length(bent)[-1], rel=5e-3)
    # samples of equal weight on discs that fan out would shift it inwards by r^2 / (4 R) = 0.09 px
    assert abs(offsets(lengths, bent, FINE[0]).mean()) < 0.01


def test_source_is_where_path_length_looks_from():
    """Magnification: a rod nearer to the source casts a longer shadow."""
    towards = source(FINE[0].P) / np.linalg.norm(source(FINE[0].P))
    spans = [np.ptp(np.flatnonzero(xray.path_length(rod((0, 0, 1), centre=towards * d), RADIUS, FINE[0])[:, 199]))
             for d in (0.0, 0.2)]
    assert spans[1] / spans[0] == pytest.approx(0.81 / (0.81 - 0.2), rel=0.02)


def test_without_any_opengl_vtk_says_so_and_does_not_crash(monkeypatch):
    pytest.importorskip('vtkmodules.vtkRenderingOpenGL2')
    monkeypatch.delenv('DISPLAY', raising=False)
    # no machine can be without its libraries for one test
    monkeypatch.setattr(vtk_scene, '_loads', lambda library: False)
    with pytest.raises(vtk_scene.NoOpenGL, match='libEGL'):
        vtk_scene.coverage(rod((1, 0, 0)), RADIUS, FINE[0])
