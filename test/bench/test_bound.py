"""The Cramer-Rao bound of a rod, by hand; and its derivatives against images of a device that has moved."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.bench import bound
from fluoro_shape_ros.geometry.curve import arc_length, frames
from fluoro_shape_ros.sim import carm, placement, scenes, shapes, xray

PITCH, LENGTH, RADIUS, BLUR, CONTRAST, PHOTONS = 0.5e-3, 0.05, 0.0004, 2.0, 0.01, 1000.0
VIEWS = carm.biplane(arm=carm.CArm(pixel_size_iso=PITCH, width=160, height=160))
# nearly along z, across both beams, but leaning enough to meet pixels at all phases
HEADING = Rotation.from_rotvec([0.0, -np.pi / 2 + 0.08, 0.06]).as_matrix()
POSE = shapes.Pose(-HEADING[:, 0] * LENGTH / 2, HEADING)


def run(bends, photons=PHOTONS, length=LENGTH):
    fields = tuple(placement.Field(v) for v in VIEWS)
    shape = shapes.Spline(length, np.asarray(bends, float), POSE)
    return scenes.Run('test', 0, fields, shape, 0.0, RADIUS, 'xray', xray.Exposure(photons, CONTRAST, BLUR))


def rod(**options):
    return run(np.zeros((4, 2)), **options)


def bent():
    return run([[0, 0], [0.4, 0.1], [0.3, 0.5], [0.0, 0.3]])


def parts(of, spacing):
    curve = of.backbone()
    tangent, first = frames(curve)
    normals = np.stack([first, np.cross(tangent, first)], axis=2)
    return curve, tangent, normals, bound.spline_basis(arc_length(curve), spacing)


def by_hand():
    """What the images tell of the rod: 1/m^3 of a sideways shift a length of device in the plane that sees it, 1/m^2 of
    its tip's along the axis.

    A thin, weak device is a Gaussian line a g(x), g of the blur's sigma b and of area 1, that ends as a Gaussian edge:
    integral of (a g')^2 dx = a^2 / (4 sqrt(pi) b^3), integral of (a g(x) g(y))^2 dx dy = a^2 / (4 pi b^2), with a noise
    of 1 / photons a pixel.
    """
    area = xray.Exposure(contrast=CONTRAST).attenuation(RADIUS) * np.pi * RADIUS**2 / PITCH             # px
    # with the pixel and the rod itself
    sigma = np.sqrt(BLUR**2 + 1 / 12 + (RADIUS / 2 / PITCH)**2)
    sideways = PHOTONS * area**2 / (4 * np.sqrt(np.pi) * sigma**3) / PITCH**3
    tip = 2 * PHOTONS * area**2 / (4 * np.pi * np.sqrt(sigma**2 * (BLUR**2 + 1 / 12))) / PITCH**2   # both planes see it
    return sideways, tip


def test_information_of_a_rod():
    device = rod()
    curve, tangent, normals, basis = parts(device, 0.01)
    a, b = (bound.information(device, i, curve, tangent, normals, basis) for i in (0, 1))
    sideways, tip = by_hand()
    # all of the rod moves along x, along y: the splines add up to one
    whole = np.array([np.append(np.tile(normals[0].T @ direction, basis.shape[1]), [0, 0])
                      for direction in np.eye(3)[:2]])
    # plane A looks along y and sees x alone, plane B the other way round
    assert_allclose([whole[0] @ a @ whole[0], whole[1] @ b @ whole[1]], sideways * LENGTH, rtol=0.05)
    assert max(whole[1] @ a @ whole[1], whole[0] @ b @ whole[0]) < 0.01 * sideways * LENGTH
    assert_allclose(np.diag(a + b)[-2:], tip, rtol=0.03)


def test_bound_of_a_rod():
    """As a cubic it has n = 4 degrees of freedom a direction; with white information their variance at s is that of the
    Legendre polynomials, K(s) = sum (2 k + 1) P_k^2 / (information L), which is n^2 at the ends."""
    sideways, tip = by_hand()
    found = bound.bound(rod(), knot_spacing=1.0)
    t = np.linspace(-1, 1, 2001)
    K = sum((2 * k + 1) * np.polynomial.Legendre.basis(k)(t)**2 for k in range(4)) / (sideways * LENGTH)
    assert_allclose(found.mean, np.sqrt(np.pi * K / 2).mean(), rtol=0.06)     # blurred ends tell a little less
    assert_allclose(found.tip, np.sqrt(2 * 16 / (sideways * LENGTH) + 1 / tip), rtol=0.06)
    assert_allclose(found.length, np.sqrt(2 / tip), rtol=0.02)


def test_information_is_what_moving_the_device_does_to_the_images():
    device = bent()
    curve, tangent, normals, basis = parts(device, 0.02)
    k, step = 2, shapes.STEP
    sideways = basis[:, k, None, None] * normals * step
    moves = [(curve + sideways[..., 0], curve - sideways[..., 0]), (curve + sideways[..., 1], curve - sideways[..., 1]),
             (np.concatenate([curve, curve[-1:] + tangent[-1] * step]), curve[:-1])]
    at, found, expected = [2 * k, 2 * k + 1, -1], 0.0, 0.0
    for i in (0, 1):
        noise = np.sqrt(device.noise_variance(device.blurred(device.sharp(curve, i), i), i))
        rows = np.array([((device.blurred(device.sharp(ahead, i), i) - device.blurred(device.sharp(behind, i), i))
                          / noise).ravel() for ahead, behind in moves])
        expected = expected + rows @ rows.T / (2 * step)**2
        found = found + bound.information(device, i, curve, tangent, normals, basis)[np.ix_(at, at)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert_allclose(found / scale, expected / scale, atol=0.05)


def test_change_of_length():
    """A circular arc that moves out gets longer by its angle times as much; ends that slide add what they slide."""
    curve = shapes.Cannula(0.04, 20.0, 0.0, 0.01, 20.0, 0.0).backbone()
    tangent, first = frames(curve)
    normals = np.stack([first, np.cross(tangent, first)], axis=2)
    basis = bound.spline_basis(arc_length(curve), 0.01)
    change = bound.length_change(arc_length(curve), tangent, normals, basis)
    outward = normals[0].T @ [0.0, -1.0, 0.0]       # the arc bends from +x towards +y
    assert_allclose(np.tile(outward, basis.shape[1]) @ change[:-2], 0.05 * 20.0, rtol=2e-3)
    assert_allclose(change[-2:], [-1, 1])
    coefficients = np.random.default_rng(0).normal(0, 1e-6, (basis.shape[1], 2))
    moved = curve + np.einsum('sj,ja,sia->si', basis, coefficients, normals)
    assert_allclose(arc_length(moved)[-1] - arc_length(curve)[-1], coefficients.ravel() @ change[:-2], rtol=0.03)


def test_four_times_the_dose_halves_it():
    once, more = bound.bound(rod(), 0.02), bound.bound(rod(photons=4 * PHOTONS), 0.02)
    assert_allclose([more.mean, more.tip, more.length], np.array([once.mean, once.tip, once.length]) / 2, rtol=1e-6)


def test_more_freedom_is_less_certain():
    few, many = bound.bound(bent(), 0.025), bound.bound(bent(), 0.008)
    assert many.mean > 1.3 * few.mean and many.tip > few.tip


def test_protocol_p_is_good_for_a_fiftieth_of_a_millimetre():
    found = bound.bound(scenes.protocol_p_run(0, 'xray'))
    assert_allclose([found.mean, found.tip, found.length], [0.020e-3, 0.109e-3, 0.094e-3], rtol=0.2)


def test_a_device_that_leaves_the_image_has_none():
    with pytest.raises(ValueError, match='both ends in both images'):
        bound.bound(rod(length=0.3))


def test_mean_norm_of_a_round_and_of_a_flat_distribution():
    assert_allclose(bound.mean_norm(np.array([np.eye(2), np.diag([0.0, 4.0])])),
                    [np.sqrt(np.pi / 2), 2 * np.sqrt(2 / np.pi)])


def test_frames_turn_with_the_curve_and_not_about_it():
    curve = shapes.Cannula(0.05, 20.0, 0.3, 0.02, 30.0, 0.3).backbone()     # in one plane
    tangent, first = frames(curve)
    normals = np.stack([first, np.cross(tangent, first)], axis=2)
    frame = np.concatenate([tangent[:, :, None], normals], axis=2)
    assert_allclose(np.einsum('nij,nik->njk', frame, frame), np.broadcast_to(np.eye(3), frame.shape), atol=1e-9)
    out_of_plane = np.array([0.0, -np.sin(0.3), np.cos(0.3)])
    share = normals.transpose(0, 2, 1) @ out_of_plane
    assert_allclose(share, np.broadcast_to(share[0], share.shape), atol=1e-3)
