"""Real anatomy in the beam: a CT volume, projected from the source of any view.

Two materials: what stands along a ray is so much water and so much bone (the two line integrals of Joseph and Spital,
J. Comput. Assist. Tomogr. 2 (1978) 100), since bone, heavier in its atoms, gains more than water where the energy
falls. A CT measures (1 + HU / 1000) times the attenuation of water, at its own energy (CT_KEV). Up to BONE_FROM that is
water of so much density. Above it is a mixture, by volume, of tissue at BONE_FROM and of pure cortical bone at CORTICAL
(1590 HU), and yet above bone alone, denser. So at CT_KEV both together attenuate just what was measured.

The volume is cut across the axis that the rays follow best. What a cut and the detector see of each other is a
homography, so each cut is one warped image, and their sum the projection.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from ..data import View
from ..device import ENERGIES_KEV, WATER
from ..geometry.cameras import pixels_per_metre, source

BONE = np.array([0.6655, 0.4242, 0.3148, 0.2229, 0.1855])   # cm^2/g at ENERGIES_KEV: cortical bone of ICRU-44 (NIST)
BONE_DENSITY = 1.92                 # g/cm^3, of the same
CT_KEV = 70.0                       # effective energy of a CT at 120 kV
BONE_FROM = 150.0                   # HU, above all soft tissue
LARGEST_SPACING = 0.05              # m, between voxels; more was meant in mm
STRAIGHT = 0.9999                   # cosine between an axis of the images and one of the patient
UNEVEN = 0.1                        # of their mean: what distances between slices may be off,
                                    # since positions are rounded
BODY = -300.0                       # HU: body, or what it encloses
COARSE = 0.004                      # m, voxels in which a body is looked for
INSIDE = 0.04                       # m of an isocentre below the skin ...
INSIDE_SHARE = 0.6                  # ... or, in a slight body, this share of the most that there is
TURN = np.deg2rad(25)               # of a patient about each axis, either way
PIXELS_A_VOXEL = 1.15               # at least, at the isocentre, that a projection is drawn with
STRIDE = 2.0                        # voxels that a ray may pass over from one cut to the next; at many more, slanted
                                    # surfaces show as stairs
FLATTEST = 0.15                     # cosine of a ray to the axis that the volume is cut across;
                                    # fields that wide are refused
CT_IMAGE = '1.2.840.10008.5.1.4.1.1.2'
KEYWORDS = ('SOPClassUID', 'ImageType', 'SeriesInstanceUID', 'ImagePositionPatient', 'ImageOrientationPatient',
            'PixelSpacing', 'Rows', 'Columns')


class CtError(ValueError):
    """A CT that can't be read or used; one line that names the file and what is wrong with it."""


@dataclass(frozen=True, eq=False)
class Volume:
    """A CT. Its frame: x to the patient's left, y to the back, z to the head; m, from the centre of voxel [0, 0, 0]."""

    hu: np.ndarray              # (Z, Y, X) int16, Hounsfield units
    spacing_m: np.ndarray       # (3,) of the voxels, in the order of `hu`: z, y, x


@dataclass(frozen=True, eq=False)
class Placement:
    """How the patient lies: reference = rotation @ (volume - isocentre_m)."""

    rotation: np.ndarray        # (3, 3) reference_from_volume
    isocentre_m: np.ndarray     # (3,) x, y, z of the volume's point that lies at the reference frame's origin


# ---- attenuation


def mass_attenuation(energy_kev: float) -> np.ndarray:
    """(2,) m^2/kg of water and of bone, at an effective energy within ENERGIES_KEV; log-log between the tabulated
    ones."""
    return 0.1 * np.array([np.exp(np.interp(np.log(energy_kev), np.log(ENERGIES_KEV), np.log(table)))
                           for table in (WATER, BONE)])


BONE_TO_WATER = float(np.divide(*mass_attenuation(CT_KEV)[::-1]))
CORTICAL = 1000 * (BONE_DENSITY * BONE_TO_WATER - 1)        # HU of pure cortical bone


def densities(hu: np.ndarray) -> np.ndarray:
    """(..., 2) float32: kg of water and of bone in a m^3 that a CT shows at (...) Hounsfield units."""
    hu = np.asarray(hu, np.float32)
    both = np.maximum(1 + hu / 1000, 0)         # g/cm^3 of the water that would attenuate as much
    share = np.clip((hu - BONE_FROM) / (CORTICAL - BONE_FROM), 0, 1)
    bone = share * np.maximum(both, 1 + CORTICAL / 1000)
    return np.stack([both - bone, bone / BONE_TO_WATER], axis=-1) * np.float32(1000)


def optical_depth(lengths: np.ndarray, energy_kev: float) -> np.ndarray:
    """(H, W) float32: the beam's attenuation, -ln of what is let through, at an effective energy within ENERGIES_KEV,
    of (H, W, 2) `path_lengths`."""
    return lengths @ mass_attenuation(energy_kev).astype(np.float32)


# ---- projection


def path_lengths(volume: Volume, view: View, pose: Placement) -> np.ndarray:
    """(H, W, 2) float32: the mass of water and of bone along each pixel's ray, kg/m^2.

    What lies behind the source does not count. Raises ValueError where the field is so wide that no axis of the volume
    follows all of its rays.
    """
    # a projection holds no more detail than its voxels: where they are large it is drawn in larger pixels, with one to
    # spare on each side
    voxel_px = pixels_per_metre(view.P, np.zeros((1, 3))) * volume.spacing_m.min()
    step = int(np.clip(voxel_px / PIXELS_A_VOXEL, 1, 4))
    shrink = np.array([[1 / step, 0, 0.5 / step + 0.5], [0, 1 / step, 0.5 / step + 0.5], [0, 0, 1]])
    M = view.P[:, :3] @ pose.rotation
    P = shrink @ np.c_[M, view.P[:, 3] - M @ pose.isocentre_m]
    drawn = _project(volume, View(view.name, P, -(-view.width // step) + 2, -(-view.height // step) + 2))
    if step > 1:
        drawn = cv2.resize(drawn, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(drawn[step:step + view.height, step:step + view.width])


def _project(volume: Volume, view: View) -> np.ndarray:
    """(H, W, 2) float32 kg/m^2, as seen by a view in the volume's frame."""
    A = np.linalg.inv(view.P[:, :3])            # from (u, v, 1) to the ray, per m of depth
    eye, spacing = source(view.P), volume.spacing_m[::-1]
    axis, ahead, flattest = _cut_across(view, A)
    across = [k for k in range(3) if k != axis]
    slant = np.sqrt(max(1 / flattest**2 - 1, 0))
    cuts = max(1, int(np.ceil(spacing[axis] * slant / (STRIDE * spacing[across].min()))))
    total = np.zeros((view.height, view.width, 2), np.float32)
    for index, cut in _cuts(np.moveaxis(volume.hu, 2 - axis, 0), cuts):
        away = index * spacing[axis] - eye[axis]
        if away * ahead < 1e-6 or not cut.any():
            continue
        # a ray A x meets the cut at eye + away * A x / (A x)[axis]
        to_cut = np.stack([*((eye[k] * A[axis] + away * A[k]) / spacing[k] for k in across), A[axis]])
        rows, columns = _shadow(view, to_cut, cut.shape)
        if rows.start < rows.stop and columns.start < columns.stop:
            size = columns.stop - columns.start, rows.stop - rows.start
            to_cut[:, 2] += to_cut @ [columns.start, rows.start, 0]
            # 0 beside the cut
            total[rows, columns] += cv2.warpPerspective(cut, to_cut, size,
                                                        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    v, u = np.mgrid[0:view.height, 0:view.width].astype(np.float32)
    rays = [np.float32(a[0]) * u + np.float32(a[1]) * v + np.float32(a[2]) for a in A]
    thickness = np.sqrt(sum(r * r for r in rays)) / np.abs(rays[axis]) * np.float32(spacing[axis] / cuts)
    return total * thickness[..., None]


def _cut_across(view: View, A: np.ndarray) -> tuple[int, int, float]:
    """The axis (x, y, z: 0, 1, 2) that all rays A (u, v, 1) of the field follow best, 1 or -1 as they do so along or
    against it, and the least cosine of one to it, which is that of a corner. Raises ValueError where that is below
    FLATTEST."""
    right, bottom = view.width - 1, view.height - 1
    corners = A @ [[0, right, 0, right], [0, 0, bottom, bottom], [1, 1, 1, 1]]
    ahead = np.where(corners[:, 0] > 0, 1, -1)
    cosines = (ahead[:, None] * corners / np.linalg.norm(corners, axis=0)).min(axis=1)
    axis = int(cosines.argmax())
    if cosines[axis] < FLATTEST:
        raise ValueError(f'plane {view.name}: its field is too wide for a CT: '
                         'no axis of the volume is near to all of its rays')
    return axis, int(ahead[axis]), float(cosines[axis])


def _shadow(view: View, to_cut: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the image that hold all that `to_cut`, a homography from pixels, takes into a cut of (h, w)
    voxels; may be empty."""
    h, w = shape[:2]
    # the outermost voxels fade out over their width
    corners = np.linalg.inv(to_cut) @ [[-1, w, -1, w], [-1, -1, h, h], [1, 1, 1, 1]]
    size = [view.width, view.height]
    if corners[2].min() * corners[2].max() <= 0:
        return slice(0, size[1]), slice(0, size[0])         # some of the cut stands beside or behind the source
    uv = corners[:2] / corners[2]
    low = np.clip(np.floor(uv.min(axis=1)), 0, size).astype(int)
    high = np.clip(np.ceil(uv.max(axis=1)) + 1, low, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _cuts(hu: np.ndarray, number: int) -> Iterator[tuple[float, np.ndarray]]:
    """The places, in slices, and the (h, w, 2) densities of `number` cuts through each slice of (N, h, w); linear
    between two slices."""
    before = here = densities(hu[0])
    for k in range(len(hu)):
        after = densities(hu[k + 1]) if k + 1 < len(hu) else here
        for off in (np.arange(number) + 0.5) / number - 0.5:
            yield (k + off, cv2.addWeighted(here, 1 - abs(off), after if off > 0 else before, abs(off), 0)
                            if off else here)
        before, here = here, after


# ---- placement


def draw_placement(rng: np.random.Generator, volume: Volume) -> Placement:
    """A patient turned by up to TURN about each axis, with a point deep inside the body at the isocentre. Raises
    CtError where there is no body."""
    places, below = _body(volume)
    deep = np.flatnonzero(below >= min(INSIDE, INSIDE_SHARE * below.max()))
    rotation = Rotation.from_euler('xyz', rng.uniform(-TURN, TURN, 3)).as_matrix()
    return Placement(rotation, places[rng.choice(deep)])


def _body(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points x, y, z in m that lie in the body, what it encloses too, and their (N,) depths in m below its
    surface or where the CT ends.

    Raises CtError where there is none.
    """
    strides = np.maximum(np.rint(COARSE / volume.spacing_m), 1).astype(int)
    coarse = volume.hu[tuple(slice(None, None, s) for s in strides)] > BODY
    pieces, count = ndimage.label(np.pad(coarse, 1))
    if not count:
        raise CtError(f'no body in the CT: nothing in it is above {BODY:g} HU')
    body = pieces == np.bincount(pieces.ravel())[1:].argmax() + 1
    body = np.stack([ndimage.binary_fill_holes(layer) for layer in body])       # airways are open in some other slice
    step = strides * volume.spacing_m
    below = ndimage.distance_transform_edt(body, sampling=step)[body]
    return ((np.argwhere(body) - 1) * step)[:, ::-1], below


# ---- files


def load_ct(path: str | Path) -> Volume:
    """The CT in an NPZ file (`hu` (z, y, x) in Hounsfield units, `spacing_m` (3,)) or in a folder with one DICOM
    series. Raises CtError.

    The array axes of an NPZ run to the head, to the back and to the patient's left. The last CT is kept; its arrays are
    read-only.
    """
    return _load(Path(path).expanduser().resolve())


@lru_cache(maxsize=1)
def _load(path: Path) -> Volume:
    if not path.exists():
        raise CtError(f'{path}: no such CT')
    volume = _checked(path, *(_dicom(path) if path.is_dir() else _npz(path)))
    for array in (volume.hu, volume.spacing_m):
        array.setflags(write=False)
    return volume


def _checked(path: Path, hu: np.ndarray, spacing: np.ndarray) -> Volume:
    if hu.ndim != 3 or min(hu.shape) < 2:
        raise CtError(f'{path}: hu must be (z, y, x) with at least 2 slices, rows and columns, got {hu.shape}')
    if spacing.shape != (3,):
        raise CtError(f'{path}: spacing_m must have 3 numbers, for z, y, x, got {spacing.shape}')
    for name, array in (('hu', hu), ('spacing_m', spacing)):
        if array.dtype.kind not in 'iuf':
            raise CtError(f'{path}: {name} is not made of numbers')
        if not np.isfinite(array).all():
            raise CtError(f'{path}: {name} is not finite')
    if not ((spacing > 0) & (spacing <= LARGEST_SPACING)).all():
        raise CtError(f'{path}: spacing_m must lie in (0, {LARGEST_SPACING:g}] m, '
                      f'got {", ".join(f"{s:g}" for s in spacing)}')
    if hu.dtype != np.int16:
        limits = np.iinfo(np.int16)
        hu = np.rint(np.clip(hu, limits.min, limits.max)).astype(np.int16)
    return Volume(np.ascontiguousarray(hu), spacing.astype(float))


def _npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    names = ('hu', 'spacing_m')
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in names if name in file}
    except Exception as error:      # on a damaged file NumPy raises anything; and a .npy is no archive
        raise CtError(f'{path}: neither an NPZ file that can be read nor a folder ({type(error).__name__})') from error
    if missing := [name for name in names if name not in arrays]:
        raise CtError(f'{path}: {" and ".join(missing)} missing')
    return arrays['hu'], arrays['spacing_m']


def _dicom(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """HU (z, y, x) and spacing in m of the one CT series in a folder. Raises CtError.

    PS3.3 C.7.6.2: ImageOrientationPatient tells where columns and rows count to, ImagePositionPatient where the first
    pixel's centre is.
    """
    headers = _headers(folder)
    if not headers:
        raise CtError(f'{folder}: no CT images in it')
    series = {p: str(h.get('SeriesInstanceUID') or '') for p, h in headers.items()}
    if nameless := [p for p, uid in series.items() if not uid]:
        raise CtError(f'{nameless[0]}: SeriesInstanceUID is missing')
    if (number := len(set(series.values()))) > 1:
        raise CtError(f'{folder}: {number} series in it; leave one')
    if len(headers) < 2:
        raise CtError(f'{folder}: a single slice; a volume needs two')
    grid = (('ImageOrientationPatient', 6), ('PixelSpacing', 2), ('Rows', 1), ('Columns', 1))
    files, grids = list(headers), np.array([[x for name, n in grid for x in _values(p, h, name, n)]
                                            for p, h in headers.items()])
    if odd := np.flatnonzero(np.abs(grids - grids[0]).max(axis=1) > 1e-3).tolist():
        raise CtError(f'{files[odd[0]]}: its orientation, spacing or size is not that of {files[0].name}')
    towards_column, towards_row = grids[0, :3], grids[0, 3:6]
    axes = np.stack([np.cross(towards_column, towards_row), towards_row, towards_column])  # of slices, rows and columns
    along = np.abs(axes).argmax(axis=1)
    if sorted(along) != [0, 1, 2] or np.abs(axes).max(axis=1).min() < STRAIGHT:
        raise CtError(f'{folder}: its slices are oblique to the patient')
    positions = np.array([_values(p, h, 'ImagePositionPatient', 3) for p, h in headers.items()])
    order = np.argsort(positions @ axes[0], kind='stable')
    steps = np.diff(positions[order], axis=0)
    mean = float((steps @ axes[0]).mean())
    if not mean > 0 or np.linalg.norm(steps - mean * axes[0], axis=1).max() > UNEVEN * mean:
        raise CtError(f'{folder}: its slices are not evenly spaced: some are missing, double or shifted')
    hu = np.stack([_slice(files[k]) for k in order])
    hu = np.flip(hu, tuple(k for k in range(3) if axes[k, along[k]] < 0))
    to_zyx = [list(along).index(k) for k in (2, 1, 0)]
    return hu.transpose(to_zyx), np.array([mean, *grids[0, 6:8]])[to_zyx] / 1e3


def _headers(folder: Path) -> dict:
    """pydicom's datasets of KEYWORDS by file, of the CT images in a folder; localizers are none. Raises CtError."""
    try:
        import pydicom
    except ImportError:
        raise CtError(f'{folder}: to read DICOM: pip install "fluoro_shape_ros[dicom]"') from None
    headers = {}
    for path in sorted(p for p in folder.iterdir() if p.is_file()):
        try:
            header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(KEYWORDS))
            # of a file cut short only the second may be left
            kinds = header.get('SOPClassUID'), header.file_meta.get('MediaStorageSOPClassUID')
            if CT_IMAGE in kinds and 'LOCALIZER' not in (header.get('ImageType') or []):
                headers[path] = header
        except pydicom.errors.InvalidDicomError:
            continue        # some other file
        except Exception as error:      # on a damaged file pydicom raises anything
            raise CtError(f'{path}: damaged: its header can\'t be read ({type(error).__name__})') from error
    return headers


def _values(path: Path, header, keyword: str, number: int) -> list[float]:
    """The `number` values of an attribute. Raises CtError."""
    try:
        values = [float(v) for v in np.atleast_1d(header.get(keyword))]
    except Exception:       # a value that is none, which pydicom only finds now
        values = []
    if len(values) != number or not np.isfinite(values).all():
        raise CtError(f'{path}: {keyword} is missing or not {number} finite numbers')
    return values


def _slice(path: Path) -> np.ndarray:
    """(Rows, Columns) int16 Hounsfield units of one DICOM file. Raises CtError."""
    import pydicom

    syntax = 'unknown'
    try:
        file = pydicom.dcmread(path)
        syntax = file.file_meta.TransferSyntaxUID.name
        stored = file.pixel_array
    except Exception as error:
        raise CtError(f'{path}: its pixels can\'t be decoded ({syntax}: {type(error).__name__})') from error
    if stored.ndim != 2:
        raise CtError(f'{path}: its pixels are not one grey image')
    slope, intercept = (_values(path, file, keyword, 1)[0] for keyword in ('RescaleSlope', 'RescaleIntercept'))
    limits = np.iinfo(np.int16)
    return np.rint(np.clip(stored * slope + intercept, limits.min, limits.max)).astype(np.int16)
