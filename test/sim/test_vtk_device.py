"""The outline of a device, as VTK draws it, against lengths worked out by hand."""

import numpy as np
import pytest

from fluoro_shape_ros.device import REST, Device, Ring, Segment, load_device
from fluoro_shape_ros.sim import carm, vtk_scene, xray

VIEW = carm.view('a', 0.0, arm=carm.CArm(pixel_size_iso=0.2e-3, width=400, height=300))
PX = 0.2e-3     # m at the isocentre
STEP = Device((Segment(0.0122, 0.0007, 'metal', 0.0005), Segment(REST, 0.0011, 'metal', 0.0006)))


@pytest.fixture(scope='module', autouse=True)
def vtk():
    """VTK, and something that it can draw with."""
    pytest.importorskip('vtkmodules.vtkRenderingOpenGL2')
    try:
        vtk_scene.coverage(rod(), 0.001, VIEW)
    except vtk_scene.NoOpenGL as error:
        pytest.skip(str(error))


def rod(length=0.03, direction=(1, 0, 0)):
    """A straight backbone whose middle is the isocentre; +x lies to the left in VIEW."""
    direction = np.array(direction, float) / np.linalg.norm(direction)
    return np.arange(-length / 2, length / 2 + 1e-9, 1e-4)[:, None] * direction


def test_a_plain_rod_is_what_coverage_draws():
    device = Device((Segment(REST, 0.001, 'metal'),))
    for backbone in (rod(), rod(direction=(0.4, 0.5, -1))):
        assert (vtk_scene.device_coverage(backbone, device, VIEW) == vtk_scene.coverage(backbone, 0.001, VIEW)).all()


def test_a_lumen_is_not_seen_from_outside():
    solid, hollow = (vtk_scene.device_coverage(rod(), Device((Segment(REST, 0.001, 'metal', lumen),)), VIEW)
                     for lumen in (0.0, 0.0008))
    assert (solid == hollow).all()


def test_area_is_that_of_all_parts():
    """Each part that stands out adds its own rectangle; where a band sits the shaft is hidden."""
    # the latter at 10, 16, 22 and 28 mm
    bands = (Ring(0.002, 0.0015, 0.0014, 'platinum'), Ring(0.010, 0.002, 0.0018, 'platinum', every=0.006))
    shadow = vtk_scene.device_coverage(rod(), Device((Segment(REST, 0.0008, 'metal'),), bands), VIEW)
    area = 2 * 0.0008 * 0.030 + 2 * (0.0014 - 0.0008) * 0.0015 + 4 * 2 * (0.0018 - 0.0008) * 0.002
    assert shadow.sum() * PX**2 == pytest.approx(area, rel=0.01)


def test_a_step_is_where_the_device_has_it():
    """The tip, at x = +15 mm, is to the left: the outline widens 12.2 mm to the right of it, from 7 to 11 px on either
    side of the middle row."""
    widths = vtk_scene.device_coverage(rod(), STEP, VIEW).sum(axis=0)
    tip, step, base = 199.5 - 75, 199.5 - 75 + 61, 199.5 + 75
    u = np.arange(400)
    assert widths[(u > tip + 1) & (u < step - 1)] == pytest.approx(7, rel=0.01)
    assert widths[(u > step + 1) & (u < base - 1)] == pytest.approx(11, rel=0.01)
    assert not widths[u < tip - 1].any() and not widths[u > base + 1].any()
    thin, thick = np.median(widths[130:180]), np.median(widths[200:260])
    # so many columns are thick, in parts, from the middle of the image back to the step, and so many are thin before
    # column 150
    assert 199.5 - (widths[150:200] - thin).sum() / (thick - thin) == pytest.approx(step, abs=0.05)
    # the rim of the end is up to 0.7 mm nearer to the source than the axis: 75 px become 75.06
    assert 149.5 - widths[:150].sum() / thin == pytest.approx(tip - 0.03, abs=0.04)


@pytest.mark.parametrize('name', ['cannula3', 'ep', 'tendon'])
def test_outline_and_shadow_cover_the_same(name):
    t = np.linspace(0, 1.2, 900)
    bent = 0.028 * np.c_[np.sin(t) - 0.5, 0.5 * t, 0.6 - np.cos(t)]
    device = load_device(name)
    outline, depth = vtk_scene.device_coverage(bent, device, VIEW), xray.optical_depth(bent, device, VIEW, 60.0)
    assert (outline[depth > 0.05 * depth.max()] > 0.05).all()
    assert (depth[outline == 1] > 0).all()


def test_beside_the_image_there_is_nothing():
    assert not vtk_scene.device_coverage(rod() + [0.5, 0, 0], STEP, VIEW).any()
