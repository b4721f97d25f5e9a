"""What the simulator draws of a device made of parts, against chords, volumes and places worked out by hand."""

import tracemalloc

import numpy as np
import pytest

from fluoro_shape_ros.device import (
    REFERENCE_KEV,
    REST,
    Device,
    DeviceError,
    Ring,
    Segment,
    attenuation,
    load_device,
    presets,
)
from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.geometry.curve import arc_length, at_arc_length
from fluoro_shape_ros.sim import carm, xray

PIXEL = 0.2e-3
FINE = carm.biplane(arm=carm.CArm(pixel_size_iso=PIXEL, width=400, height=300))
ODD = carm.biplane((0.35, -0.26), (1.4, 0.3), carm.CArm(sid=1.0, sod=0.7, pixel_size_iso=0.4e-3, width=480, height=400))
RADIUS, LUMEN, MU = 0.0012, 0.0008, 500.0


def rod(direction, length=0.03, centre=(0, 0, 0)):
    """A straight backbone; its tip lies along `direction`."""
    direction = np.array(direction, float) / np.linalg.norm(direction)
    return np.array(centre) + (np.arange(-length / 2, length / 2 + 1e-9, 1e-4)[:, None]) * direction


def arc(length=0.04, radius=0.03):
    """A bend towards the patient's right, as deep as the isocentre in view A."""
    t = (np.linspace(0, length, 2000) - length / 2) / radius
    return radius * np.c_[np.cos(t) - 1, 0 * t, np.sin(t)]


def shadow(backbone, device, view=FINE[0]):
    return xray.optical_depth(backbone, device, view, REFERENCE_KEV)


def hollow(lumen=LUMEN, mu=MU):
    return Device((Segment(REST, RADIUS, mu, lumen),))


def chord(x, radius):
    """Of a circle, at a distance x from its centre."""
    return 2 * np.sqrt(np.maximum(radius**2 - x**2, 0))


def segment(x, radius):
    """The area of a circle between its middle and x: the integral of half a chord, doubled."""
    x = np.clip(x, -radius, radius)
    return x * np.sqrt(radius**2 - x**2) + radius**2 * np.arcsin(x / radius)


# ---- thickness


@pytest.mark.parametrize('lumen', [0.0, 0.0003, LUMEN, 0.0011])
@pytest.mark.parametrize('angle_deg', [90, 60, 30])
def test_profile_across_a_hollow_cylinder(angle_deg, lumen):
    """What the outer circle's chord is longer than the lumen's, over the sine of the angle to the ray; the mean over
    each pixel."""
    angle = np.deg2rad(angle_deg)
    image = shadow(rod((0, np.cos(angle), np.sin(angle))), hollow(lumen)) / MU
    # distance of the axis from the rays between pixels
    edges = 0.81 * np.sin(np.arctan((np.arange(401) - 200) * PIXEL / 0.81))
    area = segment(edges, RADIUS) - (segment(edges, lumen) if lumen else 0)
    expected = np.diff(area) / np.diff(edges) / np.sin(angle)
    row = image[149:151].mean(axis=0)
    # beside kinks: samples are shared among pixels a third as large
    assert np.abs(row - expected).max() < 0.02 * 2 * RADIUS / np.sin(angle)
    assert row[199:201] == pytest.approx(expected[199:201], abs=0.006 * 2 * RADIUS / np.sin(angle))
    assert row.sum() == pytest.approx(expected.sum(), rel=2e-3)


def test_a_solid_device_is_the_plain_tube():
    """A number at its own energy times path lengths; where the device is oblique its ends are drawn more smoothly than
    the plain tube's."""
    backbone = arc() + np.array([0.002, 0.001, 0.003])
    for view in (*FINE, *ODD):
        plain = MU * xray.path_length(backbone, RADIUS, view)
        error = (shadow(backbone, hollow(0.0), view) - plain) / plain.max()
        assert np.abs(error).max() < (1e-6 if view is FINE[0] else 0.1) and error.std() < 2e-3


def test_metal_at_60_kev():
    """Nitinol of 55.8 % nickel: 6.45 (0.558 * 1.512 + 0.442 * 0.7661) = 7.626 1/cm, less 0.206 of water: 742 1/m, over
    2.4 mm."""
    image = xray.optical_depth(rod((0, 0, 1)), Device((Segment(REST, RADIUS, 'metal'),)), FINE[0], 60.0)
    # mean over a sixth of the radius from the axis
    assert image[150, 199:201] == pytest.approx(742.0 * 0.0024 * (1 - 1 / 216), rel=2e-3)


@pytest.mark.parametrize('energy_kev', [45.0, 79.0, 95.0])
def test_energy_scales_every_material(energy_kev):
    backbone = rod((0, 0, 1))
    for material in ('metal', 'platinum', 'polymer', MU):
        device = Device((Segment(REST, RADIUS, material, LUMEN),))
        ratio = attenuation(material, energy_kev) / attenuation(material, REFERENCE_KEV)
        assert np.allclose(xray.optical_depth(backbone, device, FINE[0], energy_kev), ratio * shadow(backbone, device),
                           rtol=1e-5, atol=1e-6)
    with pytest.raises(DeviceError, match='keV'):
        xray.optical_depth(backbone, device, FINE[0], 120.0)


@pytest.mark.parametrize('name', presets())
@pytest.mark.parametrize('backbone', [rod((1, 0, 0.4), 0.07), rod((0, 0, 1), 0.045), arc()],
                         ids=['long', 'short', 'bent'])
def test_volume_is_kept(backbone, name):
    """L du dv = dV f^2 / (z^2 cos(angle of the ray)): summed up, attenuation times volume of all parts."""
    device, view = load_device(name), FINE[0]
    v, u = np.mgrid[0:300, 0:400]
    f = 0.81 / PIXEL
    cosine = f / np.sqrt(f**2 + (u - 199.5)**2 + (v - 149.5)**2)
    pieces = device.pieces(arc_length(backbone)[-1])
    expected = sum(attenuation(p.material, 60.0) * np.pi * (p.radius**2 - p.lumen**2) * (p.stop - p.start)
                   for p in pieces)
    assert ((xray.optical_depth(backbone, device, view, 60.0) * cosine).sum() * PIXEL**2
            == pytest.approx(expected, rel=1e-3))


@pytest.mark.parametrize('lumen', [0.0, LUMEN])
@pytest.mark.parametrize('angle_deg', [60, 40, 25])
def test_an_oblique_end_is_a_ramp(angle_deg, lumen):
    """Of a slice at x off the axis, half a chord c wide, the flat end is seen over c cos(angle) to either side of its
    middle: along the axis the path falls evenly from 2 c / sin(angle) to nothing over 2 c cos(angle)."""
    angle = np.deg2rad(angle_deg)
    axis = np.array([0, np.cos(angle), np.sin(angle)])
    # its tip stands at the isocentre, v = 149.5; outward is up
    image = shadow(rod(axis, 0.03, -0.015 * axis), hollow(lumen)) / MU
    along = (np.arange(128, 171)[:, None] + (np.arange(20) + 0.5) / 20 - 0.5 - 149.5) * -PIXEL      # each pixel in 20
    expected = np.zeros(43)
    for x in (np.arange(20) + 0.5) / 20 * PIXEL:        # columns 199 and 200 lie on either side of the axis
        for radius, sign in ((RADIUS, 1), (lumen, -1)):
            c = chord(x, radius) / 2
            expected += sign * 2 * c / np.sin(angle) * np.clip(0.5 - along / (2 * c * np.cos(angle)), 0,
                                                               1).mean(axis=1) / 20 if c else 0
    found = image[128:171, 199:201].mean(axis=1)
    assert np.abs(found - expected).max() < 0.015 * 2 * RADIUS / np.sin(angle)
    assert found[0] == 0 and expected[-1] > 0


def test_a_thin_wall_is_never_brighter_than_nothing():
    """At this angle the samples of a disc fall into step with the pixels; outer and inner ones apart would beat against
    each other."""
    image = shadow(rod((1, 0, 1)), hollow(0.95 * RADIUS))
    assert image.min() >= 0
    along = [image[149 + k, 199 + k] for k in range(-20, 21)]
    assert np.ptp(along) < 0.1 * np.mean(along)
    assert np.mean(along) == pytest.approx(MU * 2 * 0.05 * RADIUS, rel=0.05)


# ---- parts


@pytest.mark.parametrize('view', [*FINE, *ODD], ids=['a', 'b', 'odd a', 'odd b'])
def test_nothing_shows_where_two_segments_of_one_make_meet(view):
    backbone = arc() + np.array([0.003, 0.004, 0.001])
    one = shadow(backbone, hollow(), view)
    two = shadow(backbone, Device((Segment(0.01234, RADIUS, MU, LUMEN), Segment(0.003, RADIUS, MU, LUMEN),
                                   Segment(REST, RADIUS, MU, LUMEN))), view)
    assert np.abs(one - two).max() < 1e-6 * one.max()


@pytest.mark.parametrize('view', [*FINE, *ODD], ids=['a', 'b', 'odd a', 'odd b'])
def test_a_band_of_the_shafts_make_makes_it_thicker(view):
    backbone = arc()
    banded = Device((Segment(REST, LUMEN, MU),), (Ring(0, 1.0, RADIUS, MU),))
    thick = shadow(backbone, hollow(0.0), view)
    error = (shadow(backbone, banded, view) - thick) / thick.max()
    assert np.abs(error).max() < 0.03 and error.std() < 0.003 and abs(error.mean()) < 1e-4


def test_order_and_kind_of_parts_do_not_matter():
    rings = (Ring(0.002, 0.001, 0.0015, 'platinum'), Ring(0.004, 0.001, 0.0014, 'metal'),
             Ring(0.006, 0.001, 0.002, 200.0, 0.005))
    shaft = (Segment(0.010, RADIUS, MU, LUMEN), Segment(REST, 0.0013, 'polymer'))
    drawn = [shadow(arc(), Device(shaft, *kinds))
             for kinds in ((rings, ()), (rings[::-1], ()), ((), rings), (rings[1:], rings[:1]))]
    assert all(np.allclose(image, drawn[0], rtol=1e-5, atol=1e-5) for image in drawn)


@pytest.mark.parametrize('tip_first', [False, True])
@pytest.mark.parametrize('backbone', [rod((0, 0, 1)), rod((0, 0.6, 0.8)), arc()[:, [1, 0, 2]]],
                         ids=['across', 'oblique', 'bent towards the source'])
def test_a_step_lies_where_it_should(backbone, tip_first):
    """Seen from the front they all stand upright: a row sums up to the cross-section, and is a half of the way where
    the joint is."""
    from_tip, view = 0.0117, FINE[0]
    backbone = backbone[::-1] if tip_first else backbone
    stepped = Device((Segment(from_tip, LUMEN, MU), Segment(REST, RADIUS, MU)))
    sections = shadow(backbone, stepped, view).sum(axis=1) / np.maximum(shadow(backbone, hollow(0.0), view).sum(axis=1),
                                                                        1e-9)
    thin, half = (LUMEN / RADIUS)**2, (1 + (LUMEN / RADIUS)**2) / 2
    v = project(view.P, at_arc_length(backbone, arc_length(backbone)[-1:] - from_tip))[0, 1]
    near = np.arange(int(v) - 12, int(v) + 13)
    profile = sections[near] if sections[near[0]] < sections[near[-1]] else sections[near][::-1]
    at = np.interp(half, profile, near if sections[near[0]] < sections[near[-1]] else near[::-1])
    assert profile[[0, -1]] == pytest.approx([thin, 1], abs=5e-3)
    assert at == pytest.approx(v, abs=0.05)


@pytest.mark.parametrize('view', [*FINE, *ODD], ids=['a', 'b', 'odd a', 'odd b'])
@pytest.mark.parametrize('reverse', [False, True])
def test_bands_lie_where_they_should(view, reverse):
    """The centroid of what a band adds is its middle; from the other end, where the tip is another. In a bend more of
    it lies on the outside, so that only where it is along the backbone counts."""
    backbone = arc(radius=0.06)[::-1 if reverse else 1]
    shaft = (Segment(0.008, RADIUS, MU, LUMEN), Segment(REST, 0.0009, MU))
    bare = shadow(backbone, Device(shaft), view)
    v, u = np.mgrid[0:view.height, 0:view.width]
    for at in (0.0, 0.0033, 0.0211):
        added = shadow(backbone, Device(shaft, (Ring(at, 0.001, 0.0014, 'platinum'),)), view) - bare
        before, middle, after = project(view.P, at_arc_length(backbone, arc_length(backbone)[-1] - at
                                                                        - np.array([0.0, 0.0005, 0.001])))
        off = np.array([(added * u).sum(), (added * v).sum()]) / added.sum() - middle
        assert abs(off @ (after - before)) / np.linalg.norm(after - before) < 0.05


def test_repeated_disks_stand_at_their_distance():
    """Every 5 mm from 2 mm on, on a rod of 30 mm: six, of which the last one, at 27 mm,
    has room for all of its 2 mm."""
    device = Device((Segment(REST, 0.0005, MU),), disks=(Ring(0.002, 0.002, 0.002, 100.0, 0.005),))
    backbone = rod((0, 0, 1))
    added = shadow(backbone, device) - shadow(backbone, Device(device.segments))
    rows = added.sum(axis=1) > added.sum(axis=1).max() / 2
    first = np.flatnonzero(np.diff(rows.astype(int)) == 1) + 1
    tip = 149.5 - 0.015 / PIXEL        # up is to the head
    assert first == pytest.approx(tip + (0.002 + 0.005 * np.arange(6)) / PIXEL, abs=1)
    assert rows.sum() == pytest.approx(6 * 10, abs=6)


# ---- the image's border


def test_half_outside_shows_the_other_half():
    """The tip, u from 400 on, lies outside; the step is at u = 350."""
    backbone = rod((-1, 0, 0), 0.06, (-0.04, 0, 0))        # u from 250 to 550
    image = shadow(backbone, Device((Segment(0.040, RADIUS, MU, LUMEN), Segment(REST, LUMEN, MU))))
    columns = image.sum(axis=0) * PIXEL / MU
    assert columns[360:399] == pytest.approx(np.pi * (RADIUS**2 - LUMEN**2), rel=0.01)
    assert columns[255:345] == pytest.approx(np.pi * LUMEN**2, rel=0.01)
    assert image[:, 399] == pytest.approx(image[:, 396], abs=float(0.01 * image.max())) and not image[:, :245].any()


def test_device_outside_leaves_the_image_alone():
    for name in presets():
        assert not shadow(rod((0, 0, 1), centre=(0.5, 0, 0)), load_device(name)).any()


def entering(direction, outside):
    """A rod that enters through the image's right border, and `outside` m of it beyond."""
    direction = np.array(direction, float) / np.linalg.norm(direction)
    return np.array([-0.0425, 0, 0]) + np.arange(-outside, 0.03, 1e-4)[:, None] * direction


def test_what_lies_outside_changes_nothing_inside():
    device = load_device('tube')
    short, long = (shadow(entering((1, 0, 0), outside), device) for outside in (0.005, 0.5))
    assert np.abs(long - short).max() < 1e-3 * short.max()


def test_a_long_shaft_costs_little():
    """Half a metre that leads 60 deg towards the source: samples as fine as its near end would ask for are twenty times
    as many."""
    towards = source(FINE[0].P) / np.linalg.norm(source(FINE[0].P))
    direction = np.array([0.5, 0, 0]) - np.sqrt(0.75) * towards
    peaks = []
    for outside in (0.01, 0.5):
        tracemalloc.start()
        image = shadow(entering(direction, outside), hollow())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert image.any() and peaks[1] < 2 * peaks[0]


def test_a_device_may_not_reach_the_source():
    towards = source(FINE[0].P) / np.linalg.norm(source(FINE[0].P))
    with pytest.raises(ValueError, match='plane a: the device reaches the X-ray source'):
        shadow(entering(-towards, 0.9), hollow())
