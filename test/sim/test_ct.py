"""Projected CTs against chords worked out by hand, and CT files that are what they should be, and some that are not."""

import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.device import ENERGIES_KEV, WATER
from fluoro_shape_ros.geometry.cameras import make_view, project, source
from fluoro_shape_ros.sim import carm, ct

SMALL = carm.CArm(pixel_size_iso=1e-3, width=200, height=160)
FINE = carm.CArm(pixel_size_iso=0.5e-3, width=300, height=260)         # more than two pixels a voxel
FRONTAL, LATERAL = carm.biplane(arm=SMALL)
ODD, STEEP = carm.biplane((0.6, -0.4), (-0.785, 0.615),
                          carm.CArm(sid=1.0, sod=0.6, pixel_size_iso=1.1e-3, width=200, height=160))
ENLARGED = carm.view('a', 0.6, -0.4, FINE)
VIEWS = [FRONTAL, LATERAL, ODD, STEEP, ENLARGED]
SPACING = np.array([2.5, 1.5, 1.2]) * 1e-3      # z, y, x
LOW, HIGH = np.array([9, 12, 6]), np.array([41, 32, 24])            # voxels x, y, z of the box, first and past the last
BOX = (LOW - 0.5) * SPACING[::-1], (HIGH - 0.5) * SPACING[::-1]
AHEAD = ct.Placement(np.eye(3), (BOX[0] + BOX[1]) / 2)
TURNED = ct.Placement(Rotation.from_euler('xyz', [0.3, -0.4, 0.2]).as_matrix(),
                      AHEAD.isocentre_m + [0.021, -0.014, 0.009])
WATER_ALONE, BONE_ALONE = 0, 1


def box(hu=0, shape=(30, 44, 50)):
    volume = np.full(shape, -1000, np.int16)
    volume[tuple(slice(a, b) for a, b in zip(LOW[::-1], HIGH[::-1]))] = hu
    return ct.Volume(volume, SPACING)


def rays(view, pose):
    """The source and the (H, W, 3) directions of the pixels' rays in the volume's frame."""
    v, u = np.mgrid[0:view.height, 0:view.width]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view.P[:, :3]).T
    return (source(view.P) @ pose.rotation + pose.isocentre_m,
            rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ pose.rotation)


def chords(view, pose, grown=0.0):
    """(H, W) m that each ray has in BOX, grown by so many voxels on each side: between its entry into the last slab and
    its exit from the first."""
    eye, directions = rays(view, pose)
    low, high = BOX[0] - grown * SPACING[::-1], BOX[1] + grown * SPACING[::-1]
    with np.errstate(divide='ignore'):
        t = np.stack([(low - eye) / directions, (high - eye) / directions])
    return np.maximum(t.max(axis=0).min(axis=-1) - np.maximum(t.min(axis=0).max(axis=-1), 0), 0)


# ---- attenuation


@pytest.mark.parametrize('hu, water, bone', [
    (-1024, 0, 0), (-1000, 0, 0), (-500, 500, 0), (0, 1000, 0), (150, 1150, 0),
    (ct.CORTICAL, 0, 1920),
    ((150 + ct.CORTICAL) / 2, 575, 960),        # half of each, by volume
    (1000 * (2 * 1.92 * ct.BONE_TO_WATER - 1), 0, 2 * 1920),
])
def test_what_a_voxel_is_made_of(hu, water, bone):
    assert ct.densities(np.array(hu)) == pytest.approx([water, bone], abs=1e-3)


def test_cortical_bone_is_where_a_ct_has_it():
    assert 1400 < ct.CORTICAL < 1700


def test_both_attenuate_as_the_ct_measured():
    hu = np.arange(-1000, 3071, 10)
    of_water = ct.optical_depth(ct.densities(np.zeros(1)), ct.CT_KEV)
    np.testing.assert_allclose(ct.optical_depth(ct.densities(hu), ct.CT_KEV) / of_water, 1 + hu / 1000, atol=1e-5)
    lower = ct.optical_depth(ct.densities(hu), 50.0) / ct.optical_depth(ct.densities(np.zeros(1)), 50.0)
    assert (lower[hu > 200] > 1.01 * (1 + hu[hu > 200] / 1000)).all()       # bone gains more than water at less energy
    np.testing.assert_allclose(lower[hu <= 150], 1 + hu[hu <= 150] / 1000, atol=1e-5)


def test_optical_depth_of_a_centimetre():
    """mu / rho times rho times 1 cm; 10 kg/m^2 are 1 g/cm^2."""
    lengths = np.array([[[10.0, 0.0], [0.0, 19.2], [10.0, 19.2]]], np.float32)
    depths = ct.optical_depth(lengths, 60.0)
    assert depths.dtype == np.float32 and depths.shape == (1, 3)
    assert depths[0] == pytest.approx([0.2059, 0.3148 * 1.92, 0.2059 + 0.3148 * 1.92], rel=1e-5)
    between = ct.optical_depth(lengths, np.sqrt(60.0 * 80.0))
    assert between[0, 0] == pytest.approx(np.sqrt(0.2059 * 0.1837), rel=1e-5)      # a line in log-log


def test_bone_attenuates_more_than_as_much_water():
    for energy, water in zip(ENERGIES_KEV, WATER):
        of_water, of_bone = ct.mass_attenuation(energy)
        assert of_water == pytest.approx(water / 10) and of_bone > 1.05 * of_water


# ---- projection


@pytest.mark.parametrize('pose', [AHEAD, TURNED])
@pytest.mark.parametrize('view', VIEWS)
def test_chords_of_a_box(view, pose):
    """Voxels fade out over their width, to both sides of the box's border, and the last cut may stand half a voxel off
    it. So a chord lies between those of a box that is a voxel smaller and of one that is a voxel larger (two, where
    what is drawn was enlarged); on average it is right, to half a pixel of the 40 that the box is wide."""
    lengths = ct.path_lengths(box(), view, pose)
    assert lengths.shape == (view.height, view.width, 2) and lengths.dtype == np.float32
    assert not lengths[..., BONE_ALONE].any()
    seen, true = lengths[..., WATER_ALONE] / 1000, chords(view, pose)
    voxels, room = 2 if view is ENLARGED else 1, 1e-4 * true.max()
    assert (seen >= chords(view, pose, -voxels) - room).all() and (seen <= chords(view, pose, voxels) + room).all()
    assert seen.sum() == pytest.approx(true.sum(), rel=0.01)
    assert np.abs(seen - true).mean() < 0.02 * true[true > 0].mean()
    # nothing at all outside the shadow
    far = chords(view, pose, 2) == 0
    assert far.sum() > 1000 and (lengths[far] == 0).all()


@pytest.mark.parametrize('view', [FRONTAL, ODD])
def test_bone_comes_second(view):
    """A box of cortical bone has 1.92 times the mass of one of water, and no water."""
    water, bone = ct.path_lengths(box(), view, TURNED), ct.path_lengths(box(round(ct.CORTICAL)), view, TURNED)
    np.testing.assert_allclose(bone[..., BONE_ALONE], 1.92 * water[..., WATER_ALONE], rtol=1e-3)
    assert bone[..., WATER_ALONE].max() < 1e-3 * water.max()


@pytest.mark.parametrize('view', VIEWS)
def test_chords_of_a_sphere(view):
    """2 sqrt(r^2 - d^2) at distance d of its centre; partly filled voxels hold their share,
    so only their width blurs it."""
    radius, n = 0.03, np.array([34, 50, 64])
    fine = np.stack(np.meshgrid(*((np.arange(4 * k) - 1.5) / 4 * s for k, s in zip(n, SPACING)), indexing='ij'))
    centre = (n - 1) / 2 * SPACING + [1e-3, -0.4e-3, 0.3e-3]
    inside = ((fine - centre[:, None, None, None])**2).sum(axis=0) < radius**2
    share = inside.reshape(n[0], 4, n[1], 4, n[2], 4).mean(axis=(1, 3, 5))
    pose = ct.Placement(TURNED.rotation, centre[::-1] + [0.01, -0.02, 0.015])
    seen = ct.path_lengths(ct.Volume(np.rint(1000 * share - 1000).astype(np.int16), SPACING), view,
                           pose)[..., WATER_ALONE] / 1000
    eye, directions = rays(view, pose)
    d = np.linalg.norm(np.cross(centre[::-1] - eye, directions), axis=-1)
    true = 2 * np.sqrt(np.maximum(radius**2 - d**2, 0))
    well = d < 0.8 * radius         # beyond, the chord falls too steeply for voxels of a twelfth of the radius
    assert well.sum() > 1000
    assert np.abs(seen - true)[well].max() < 0.03 * 2 * radius
    assert np.abs((seen - true)[well].mean()) < 0.003 * 2 * radius
    assert (seen[d > radius + 2 * SPACING.max()] == 0).all()


@pytest.mark.parametrize('angles', [(0, 0), (1.571, 0), (0.6, -0.4), (0.2, 1.3), (-0.785, 0.615)])
def test_mass_is_kept(angles):
    """Seen from afar the rays are parallel, and the sum of what is along them times a pixel's area is the mass; of
    noise, that pixels sample."""
    rng = np.random.default_rng(1)
    volume = ct.Volume(np.pad(rng.integers(-1000, 2500, (12, 14, 18)), 1, constant_values=-1000).astype(np.int16),
                       SPACING)
    pose = ct.Placement(TURNED.rotation, (np.array([20, 16, 14]) - 1) / 2 * SPACING[::-1])
    view = carm.view('a', *angles, carm.CArm(sid=120.0, sod=100.0, pixel_size_iso=0.4e-3, width=160, height=160))
    masses = ct.path_lengths(volume, view, pose).sum(axis=(0, 1), dtype=float) * 0.4e-3**2
    assert masses == pytest.approx(ct.densities(volume.hu).sum(axis=(0, 1, 2), dtype=float) * SPACING.prod(), rel=5e-3)


@pytest.mark.parametrize('view', VIEWS)
def test_a_voxel_is_seen_where_it_is(view):
    """Up, down, left and right: the shadow's centroid is the projected centre of the voxel."""
    v, u = np.mgrid[0:view.height, 0:view.width]
    for at in ([4, 4, 3], [45, 4, 3], [4, 39, 3], [4, 4, 26], [40, 33, 20]):
        hu = np.full((30, 44, 50), -1000, np.int16)
        hu[tuple(at[::-1])] = 3000
        shadow = ct.path_lengths(ct.Volume(hu, SPACING), view, TURNED).sum(axis=2)
        true = project(view.P, TURNED.rotation @ (at * SPACING[::-1] - TURNED.isocentre_m))
        assert ([(shadow * u).sum() / shadow.sum(), (shadow * v).sum() / shadow.sum()]
                == pytest.approx(list(true), abs=0.1))


def test_the_head_is_up_and_the_face_in_front():
    """In the frontal view v runs to the feet and u to the patient's right; in the left lateral one u to the front."""
    hu = np.full((30, 44, 50), -1000, np.int16)
    hu[25, 10, 40] = 0          # towards the head, to the front, to the left
    pose = ct.Placement(np.eye(3), np.array([25, 22, 15]) * SPACING[::-1])
    for view, u_sign in ((FRONTAL, -1), (LATERAL, 1)):
        v, u = np.unravel_index(ct.path_lengths(ct.Volume(hu, SPACING), view, pose)[..., WATER_ALONE].argmax(),
                                (view.height, view.width))
        assert v < view.height / 2 - 5 and u_sign * (u - view.width / 2) > 5


@pytest.mark.parametrize('view', [ODD, ENLARGED])
def test_a_shifted_isocentre_is_a_shifted_camera(view):
    """P [R (x - c) - d] has t - M d for t. A turned patient is a turned camera."""
    moved = ct.Placement(TURNED.rotation, TURNED.isocentre_m + TURNED.rotation.T @ [0.01, 0.02, -0.03])
    camera = make_view('a', np.c_[view.P[:, :3], view.P[:, 3] - view.P[:, :3] @ [0.01, 0.02, -0.03]], view.width,
                       view.height)
    seen = ct.path_lengths(box(), view, moved)
    assert seen.any()
    np.testing.assert_allclose(seen, ct.path_lengths(box(), camera, TURNED), atol=2e-3 * seen.max())
    turned = make_view('a', np.c_[view.P[:, :3] @ TURNED.rotation, view.P[:, 3]], view.width, view.height)
    np.testing.assert_allclose(ct.path_lengths(box(), turned, ct.Placement(np.eye(3), moved.isocentre_m)), seen,
                               atol=2e-3 * seen.max())


@pytest.mark.parametrize('view', VIEWS)
def test_what_is_homogeneous_shows_no_seams(view):
    """Away from the projected edges of a large block the path changes as smoothly as its chord; to nothing but rounding
    where all rays pass all cuts, and else by what a cut is wide where the rays enter through a side of the block: a
    small share of hundreds of them."""
    hu = np.zeros((60, 100, 130), np.int16)
    centre = (np.array(hu.shape[::-1]) - 1) / 2 * SPACING[::-1]
    low, high = -SPACING[::-1] / 2, 2 * centre + SPACING[::-1] / 2
    seen = ct.path_lengths(ct.Volume(hu, SPACING), view, ct.Placement(np.eye(3), centre))[..., WATER_ALONE]
    eye, directions = rays(view, ct.Placement(np.eye(3), centre))
    t = np.stack([(low - eye) / directions, (high - eye) / directions])
    true = 1000 * np.maximum(t.max(axis=0).min(axis=-1) - t.min(axis=0).max(axis=-1), 0)
    bends, true_bends = (np.abs(cv2.Laplacian(x.astype(float), -1, ksize=1)) for x in (seen, true))
    smooth = cv2.erode(((true_bends < 1e-4 * true.max()) & (true > 0.3 * true.max())).astype(np.uint8),
                       np.ones((9, 9))) > 0
    assert smooth.sum() > 5000
    through = view in (FRONTAL, LATERAL)
    assert np.abs(seen - true)[smooth].max() < (1e-4 if through else 3e-3) * true[smooth].mean()
    assert bends[smooth].max() < (2e-4 if through else 0.015) * true[smooth].mean()


def test_between_slices_cuts_are_linear():
    """In a ramp of 100 kg/m^3 a slice each cut has what its place says, and the ends go on as they are."""
    ramp = np.repeat(np.arange(-800, 0, 100), 6).reshape(8, 2, 3).astype(np.int16)
    for number in (1, 2, 3):
        places, cuts = zip(*ct._cuts(ramp, number))
        np.testing.assert_allclose(places, (np.arange(8 * number) + 0.5) / number - 0.5)
        expected = 200 + 100 * np.clip(places, 0, 7)
        np.testing.assert_allclose(np.stack(cuts)[..., WATER_ALONE],
                                   np.broadcast_to(expected[:, None, None], (8 * number, 2, 3)), rtol=1e-5)


def test_what_is_behind_the_source_does_not_count():
    """The source within the box sees what is before it; one that the box is behind sees nothing."""
    eye = source(FRONTAL.P)
    within = ct.Placement(np.eye(3), AHEAD.isocentre_m + [0.002, 0.003, 0.001] - eye)
    seen, true = ct.path_lengths(box(), FRONTAL, within)[..., WATER_ALONE] / 1000, chords(FRONTAL, within)
    assert 0.01 < true.min() < true.max() < 0.03
    np.testing.assert_allclose(seen, true, atol=SPACING[1])
    behind = ct.Placement(np.eye(3), AHEAD.isocentre_m - 1.2 * eye)
    assert not ct.path_lengths(box(), FRONTAL, behind).any()


def test_a_source_at_infinity():
    """All rays lie along one axis, as far as numbers tell."""
    afar = carm.view('a', 0.0, arm=carm.CArm(sid=2e9, sod=1e9, pixel_size_iso=1e-3, width=1, height=1))
    assert (ct.path_lengths(box(), afar, AHEAD)[0, 0, WATER_ALONE]
            == pytest.approx(1000 * (BOX[1] - BOX[0])[1], rel=1e-3))


def test_beside_the_field_there_is_nothing():
    assert not ct.path_lengths(box(), FRONTAL, ct.Placement(np.eye(3), AHEAD.isocentre_m + [0.4, 0, 0])).any()


def test_a_field_too_wide_is_refused():
    wide = make_view('b', np.array([[20.0, 0, 50, 25], [0, 20.0, 50, 25], [0, 0, 1, 0.5]]), 100, 100)
    with pytest.raises(ValueError, match='plane b: its field is too wide'):
        ct.path_lengths(box(), ct.View('b', wide.P, 400, 400), AHEAD)


# ---- placement


def body():
    """A cylinder of water 100 mm across and 100 mm long, hollow along its axis, with a table beside it; both in air. m
    at its axis (x, y)."""
    z, y, x = np.meshgrid(np.arange(60) * SPACING[0], np.arange(90) * SPACING[1], np.arange(120) * SPACING[2],
                          indexing='ij')
    r = np.hypot(x - 0.07, y - 0.06)
    hu = np.where((r < 0.05) & (r > 0.01) & (z > 0.02) & (z < 0.12), 0, -1000)
    hu[:, 84:87, 10:110] = 300
    return ct.Volume(hu.astype(np.int16), SPACING)


def test_an_isocentre_lies_deep_inside_the_body():
    volume = body()
    draws = [ct.draw_placement(np.random.default_rng(seed), volume) for seed in range(40)]
    for pose in draws:
        x, y, z = pose.isocentre_m
        # the most is 0.05, of which 60 %, less a coarse voxel
        assert np.hypot(x - 0.07, y - 0.06) < 0.05 - 0.02 and 0.02 + 0.02 < z < 0.12 - 0.02
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
        angles = Rotation.from_matrix(pose.rotation).as_euler('xyz')
        assert (np.abs(angles) <= ct.TURN).all()
    assert len({tuple(pose.isocentre_m) for pose in draws}) > 20
    # what the body encloses is inside it
    assert min(np.hypot(*(pose.isocentre_m[:2] - [0.07, 0.06])) for pose in draws) < 0.01
    again = ct.draw_placement(np.random.default_rng(3), volume)
    assert (again.isocentre_m == draws[3].isocentre_m).all() and (again.rotation == draws[3].rotation).all()


def test_in_air_there_is_no_body():
    with pytest.raises(ct.CtError, match='no body'):
        ct.draw_placement(np.random.default_rng(0), ct.Volume(np.full((9, 9, 9), -1000, np.int16), SPACING))


# ---- NPZ


HU = np.random.default_rng(0).integers(-1000, 2000, (4, 5, 6)).astype(np.int16)


@pytest.mark.parametrize('kind', [np.int16, np.int32, np.float32, '>i2'])
def test_npz(tmp_path, kind):
    np.savez_compressed(tmp_path / 'ct.npz', hu=HU.astype(kind), spacing_m=SPACING)
    volume = ct.load_ct(tmp_path / 'ct.npz')
    assert volume.hu.dtype == np.int16 and (volume.hu == HU).all() and (volume.spacing_m == SPACING).all()
    assert ct.load_ct(str(tmp_path / 'ct.npz')) is volume
    with pytest.raises(ValueError, match='read-only'):
        volume.hu[0] = 0


def test_beyond_int16_values_are_cut(tmp_path):
    np.savez(tmp_path / 'ct.npz', hu=np.array([[[-1e6, 1e6]] * 2] * 2), spacing_m=SPACING)
    assert ct.load_ct(tmp_path / 'ct.npz').hu[0, 0].tolist() == [-32768, 32767]


@pytest.mark.parametrize('content, message', [
    (dict(hu=HU), 'spacing_m missing'),
    (dict(spacing_m=SPACING), 'hu missing'),
    (dict(other=HU), 'hu and spacing_m missing'),
    (dict(hu=HU[0], spacing_m=SPACING), r'hu must be \(z, y, x\)'),
    (dict(hu=HU[:1], spacing_m=SPACING), 'at least 2 slices'),
    (dict(hu=HU, spacing_m=SPACING[:2]), 'spacing_m must have 3 numbers'),
    (dict(hu=HU, spacing_m=SPACING * [1, 0, 1]), r'spacing_m must lie in \(0, 0.05\] m, got 0.0025, 0, 0.0012'),
    (dict(hu=HU, spacing_m=-SPACING), 'spacing_m must lie in'),
    (dict(hu=HU, spacing_m=SPACING * 1e3), 'spacing_m must lie in'),       # mm
    (dict(hu=HU, spacing_m=SPACING * np.nan), 'spacing_m is not finite'),
    (dict(hu=np.full((3, 3, 3), np.inf), spacing_m=SPACING), 'hu is not finite'),
    (dict(hu=HU.astype(str), spacing_m=SPACING), 'hu is not made of numbers'),
    (dict(hu=HU.astype(object), spacing_m=SPACING), 'neither an NPZ file that can be read'),
])
def test_npz_that_are_no_ct(tmp_path, content, message):
    np.savez(tmp_path / 'ct.npz', **content)
    refused(tmp_path / 'ct.npz', message)


def refused(path, message):
    """One line that begins with the file."""
    with pytest.raises(ct.CtError, match=message) as error:
        ct.load_ct(path)
    assert str(error.value).startswith(str(path)) and '\n' not in str(error.value)


def test_files_that_are_no_npz(tmp_path):
    refused(tmp_path / 'none.npz', 'no such CT')
    (tmp_path / 'text.npz').write_text('not a zip')
    refused(tmp_path / 'text.npz', 'neither an NPZ file')
    np.save(tmp_path / 'array.npy', HU)
    refused(tmp_path / 'array.npy', 'neither an NPZ file')
    np.savez(tmp_path / 'cut.npz', hu=HU, spacing_m=SPACING)
    (tmp_path / 'cut.npz').write_bytes((tmp_path / 'cut.npz').read_bytes()[:-60])
    refused(tmp_path / 'cut.npz', 'neither an NPZ file')


# ---- DICOM


AXES = dict(L=(1, 0, 0), R=(-1, 0, 0), P=(0, 1, 0), A=(0, -1, 0), H=(0, 0, 1), F=(0, 0, -1))


@pytest.fixture
def series(tmp_path):
    """Writes HU as one file a slice: columns count towards the first letter, rows towards the second. Attributes given
    as a list are by slice."""
    pydicom = pytest.importorskip('pydicom', '3.0.1')

    def write(letters='LP', slope=1.0, intercept=-1024.0, folder=tmp_path / 'ct', keep=slice(None), **attributes):
        folder.mkdir(exist_ok=True)
        right, down = (np.array(AXES[letter]) for letter in letters)
        along = np.cross(right, down)
        size = np.array(HU.shape[::-1])
        counts = [int(size[np.flatnonzero(a)[0]]) for a in (along, down, right)]
        first = np.where(along + down + right < 0, size - 1, 0)
        index = first + np.einsum('ksrc,ki->srci', np.indices(counts), np.stack([along, down, right]))
        stored = np.rint((HU[index[..., 2], index[..., 1], index[..., 0]] - intercept) / slope).astype(np.int16)
        mm = SPACING[::-1] * 1e3
        numbers = list(range(counts[0]))[keep]
        for k in numbers:
            file = pydicom.dataset.Dataset()
            file.file_meta = pydicom.dataset.FileMetaDataset()
            file.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
            file.file_meta.MediaStorageSOPClassUID, file.file_meta.MediaStorageSOPInstanceUID = (
                ct.CT_IMAGE, pydicom.uid.generate_uid())
            given = dict(SOPClassUID=ct.CT_IMAGE, SOPInstanceUID=file.file_meta.MediaStorageSOPInstanceUID,
                         SeriesInstanceUID='1.2.3',
                         ImageType=['ORIGINAL', 'PRIMARY', 'AXIAL'], PatientName='Secret^Somebody', Rows=counts[1],
                         Columns=counts[2], SamplesPerPixel=1, PhotometricInterpretation='MONOCHROME2',
                         BitsAllocated=16, BitsStored=16, HighBit=15, PixelRepresentation=1, RescaleSlope=slope,
                         RescaleIntercept=intercept, PixelSpacing=[np.abs(down) @ mm, np.abs(right) @ mm],
                         ImageOrientationPatient=[*map(float, right), *map(float, down)],
                         ImagePositionPatient=list(np.round((first + k * along) * mm - [100.0, 50.0, 30.0], 3)),
                         PixelData=stored[k].tobytes())
            given |= {name: value[k] if isinstance(value, list) else value for name, value in attributes.items()}
            for keyword, value in given.items():
                if value is not None:
                    setattr(file, keyword, value)
            file['PixelData'].VR = 'OW'
            file.save_as(folder / f'{(7 * k + 3) % 11:02d}.dcm', enforce_file_format=True)      # not in order of names
        return folder

    return write


@pytest.mark.parametrize('letters', ['LP', 'RP', 'LA', 'RA', 'PL', 'AL', 'LF', 'RF', 'RH', 'PF', 'AF', 'PH', 'FL'])
def test_dicom_in_any_straight_orientation(series, letters):
    volume = ct.load_ct(series(letters))
    assert volume.hu.dtype == np.int16 and (volume.hu == HU).all()
    assert volume.spacing_m == pytest.approx(SPACING, rel=1e-3)


def test_dicom_with_another_rescale_and_other_files_about(series):
    folder = series(slope=0.5, intercept=-200.0)
    (folder / 'notes.txt').write_text('not a DICOM file')
    (folder / 'empty').touch()
    (folder / 'sub').mkdir()
    series(ImageType=['ORIGINAL\\PRIMARY\\LOCALIZER'] * 4, SeriesInstanceUID='1.2.4',
           folder=folder.parent / 'localizer', keep=slice(1))
    (folder.parent / 'localizer' / '03.dcm').rename(folder / 'localizer.dcm')
    assert (ct.load_ct(folder).hu == HU).all()


@pytest.mark.parametrize('wrong, message', [
    (dict(SeriesInstanceUID=['1.2.3', '1.2.3', '1.2.4', '1.2.3']), '2 series in it'),
    (dict(SOPClassUID='1.2.840.10008.5.1.4.1.1.4'), 'no CT images in it'),
    (dict(keep=slice(0, 1)), 'a single slice'),
    (dict(keep=slice(0, 4, 3)), None),                                      # two slices are evenly spaced
    (dict(ImagePositionPatient=[[0, 0, z] for z in (0, 2, 4, 8)]), 'not evenly spaced'),
    (dict(ImagePositionPatient=[[0, 0, z] for z in (0, 2, 2, 4)]), 'not evenly spaced'),
    (dict(ImagePositionPatient=[[0, 0, 0]] * 4), 'not evenly spaced'),
    (dict(ImagePositionPatient=[[0, z / 2, z] for z in (0, 2, 4, 6)]), 'not evenly spaced'),      # a tilted gantry
    (dict(ImagePositionPatient=[[0, 0, z] for z in (0, 2, 4.1, 6)]), None),                       # rounded
    (dict(ImageOrientationPatient=[[1.0, 0, 0, 0, 0.98, 0.199]] * 4), 'oblique'),
    (dict(ImageOrientationPatient=None), 'ImageOrientationPatient is missing or not 6'),
    (dict(PixelSpacing=[[1.2, 1.4], [1.2, 1.5], [1.2, 1.5], [1.2, 1.5]]),
     r'ct/03.dcm: its orientation, spacing or size is not that of 02.dcm'),
    (dict(RescaleSlope=None), 'RescaleSlope is missing'),
    (dict(PixelData=bytes(10)), r'can\'t be decoded \(Explicit VR Little Endian: '),
    (dict(PixelSpacing=[[0.0, 1.0]] * 4), r'spacing_m must lie in \(0'),
    (dict(ImagePositionPatient=['', '', '', '']), 'ImagePositionPatient is missing or not 3'),
])
def test_dicom_that_is_no_ct(series, wrong, message):
    folder = series(**wrong)
    if message is None:
        ct.load_ct(folder)
        return
    with pytest.raises(ct.CtError, match=message) as error:
        ct.load_ct(folder)
    assert (str(error.value).startswith(str(folder)) and '\n' not in str(error.value)
            and 'Secret' not in str(error.value))


def test_dicom_that_is_damaged(series):
    folder = series()
    content = (folder / '03.dcm').read_bytes()
    (folder / '03.dcm').write_bytes(content[:400])
    with pytest.raises(ct.CtError, match='03.dcm'):
        ct.load_ct(folder)


def test_compressed_pixels_without_a_decoder(series):
    import pydicom

    folder = series()
    for path in folder.iterdir():
        file = pydicom.dcmread(path)
        file.file_meta.TransferSyntaxUID = pydicom.uid.MPEG2MPML
        file.PixelData = pydicom.encaps.encapsulate([bytes(20)])
        file['PixelData'].VR = 'OB'
        file.save_as(path)
    with pytest.raises(ct.CtError, match=r'can\'t be decoded \(MPEG2 Main Profile / Main Level: NotImplementedError\)'):
        ct.load_ct(folder)


def test_without_pydicom_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pydicom', None)
    with pytest.raises(ct.CtError, match=r'pip install "fluoro_shape_ros\[dicom\]"'):
        ct.load_ct(tmp_path)
