"""Beads at known positions: tables of them, and the projection that they tell.

HZ is Hartley & Zisserman, Multiple View Geometry in Computer Vision, 2nd edition.
"""

from __future__ import annotations

import codecs
import csv
import re
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ..geometry.cameras import depth, project, triangulate

MIN_BEADS = 6           # 11 unknowns, 2 equations a bead (HZ 7.1)
MIN_SPREAD = 0.02       # of the 11th singular value against the first: beads as flat as 1:40 leave errors of several px
                        # between them
FOLDS = 10              # parts of the beads that are left out of the fit in turn
UNITS = {'m': 1.0, 'mm': 1e-3}
EXTENT = 1e-3, 5.0      # m; a phantom that is smaller or larger has its positions in another unit than the table says
MAX_TABLE = 10**7       # bytes
SAME = 1e-6             # m; nearer positions in two tables are the same bead


class CalibrationError(ValueError):
    """Beads or pictures that do not tell a projection; the message says why."""


class Beads(NamedTuple):
    """What a table says."""

    points: np.ndarray      # (N, 3) m, in the reference frame
    pixels_px: np.ndarray   # (N, 2)


# ---- tables


def read_beads(path: str) -> Beads:
    """The beads in a table with the columns x_mm, y_mm, z_mm (or x_m, y_m, z_m), u_px and v_px. Raises CalibrationError
    and OSError, see read_points."""
    (points,), pixels = read_points(path, [''], ['u_px', 'v_px'])
    return Beads(points, pixels)


def read_points(path: str, prefixes: list[str], others: list[str]) -> tuple[list[np.ndarray], np.ndarray]:
    """(N, 3) m of the columns PREFIXx_mm, ... (or PREFIXx_m, ...) for each prefix, and (N, M) of `others`, from a text
    table.

    Commas, semicolons or tabs stand between the columns, in UTF-8, UTF-16 or Latin-1; where there are semicolons or
    tabs, a comma in a number is a decimal point. Raises CalibrationError for missing columns, what is no number and
    positions in another unit than the columns say; OSError where there is no such file.
    """
    lines = [line for line in _text(path).splitlines() if line.strip() and not line.startswith(('#', 'sep='))]
    delimiter = max(';\t,', key=(lines[0] if lines else '').count)
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)]
    names = [re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_') for name in rows[0]] if rows else []
    columns = {unit: [f'{prefix}{axis}_{unit}' for prefix in prefixes for axis in 'xyz'] + others for unit in UNITS}
    unit = next((unit for unit in UNITS if set(columns[unit]) <= set(names)), None)
    if unit is None:
        vectors = [', '.join(f'{prefix}{axis}_{u}' for prefix in prefixes for axis in 'xyz') for u in ('mm', 'm')]
        needed, found = (f'{vectors[0]} (or {vectors[1]})' + (f', {" and ".join(others)}' if others else ''),
                         ', '.join(rows[0] if rows else ())[:80] or 'an empty one')
        raise CalibrationError(f'{path}: needs a first line with {needed}, not {found}')
    values = []
    for number, row in enumerate(rows[1:], 1):
        try:
            values.append([float(row[k] if delimiter == ',' else row[k].replace(',', '.'))
                           for k in map(names.index, columns[unit])])
        except (IndexError, ValueError):
            raise CalibrationError(f'{path}: line {number + 1} has something that is no number') from None
    table = np.array(values).reshape(-1, len(columns[unit]))
    points = [table[:, 3 * k:3 * k + 3] * UNITS[unit] for k in range(len(prefixes))]
    for prefix, some in zip(prefixes, points):
        _check_unit(path, some, unit, prefix)
    return points, table[:, 3 * len(prefixes):]


def _text(path: str) -> str:
    """What a spreadsheet or an editor wrote, in whatever of the usual encodings."""
    with open(path, 'rb') as file:
        data = file.read(MAX_TABLE + 1)
    if data.startswith((b'PK\x03\x04', b'\xd0\xcf\x11\xe0')):
        raise CalibrationError(f'{path}: a workbook of a spreadsheet; save the sheet as CSV')
    if len(data) > MAX_TABLE:
        raise CalibrationError(f'{path}: larger than any table of beads')
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings: tuple[str, ...] = ('utf-16',)
    elif b'\0' in data[:4]:
        encodings = ('utf-16-be',) if data[:1] == b'\0' else ('utf-16-le',)
    else:
        encodings = 'utf-8-sig', 'latin-1'
    for encoding in encodings:
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            pass
    raise CalibrationError(f'{path}: no text')


def _check_unit(path: str, points: np.ndarray, unit: str, prefix: str) -> None:
    """Raises CalibrationError where positions would lie within a grain or a house."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) > 1 and np.isfinite(points).all() else EXTENT[1]
    if not EXTENT[0] <= extent <= EXTENT[1]:
        other, names = 'metres' if unit == 'mm' else 'millimetres', ', '.join(f'{prefix}{axis}_{unit}'
                                                                              for axis in 'xyz')
        raise CalibrationError(f'{path}: the points lie within {extent / UNITS[unit]:.3g} {unit} by its columns '
                               f'{names}: are these {other}?')


# ---- the projection


def projection_from_points(points: np.ndarray, pixels_px: np.ndarray) -> np.ndarray:
    """(3, 4) P that maps (N, 3) points in m to (N, 2) pixels with the least squared reprojection error; |P[2, :3]| = 1,
    all points in front.

    The direct linear transformation on normalised coordinates (HZ 7.1), then Levenberg-Marquardt on the pixels
    (HZ 7.2); no distortion. Raises CalibrationError for fewer than MIN_BEADS, values that are not finite, points
    (nearly) in one plane, and points on both sides of the source.
    """
    points, pixels_px = np.asarray(points, float), np.asarray(pixels_px, float)
    if len(points) != len(pixels_px) or len(points) < MIN_BEADS:
        raise CalibrationError(f'{len(points)} beads and {len(pixels_px)} pixels: '
                               f'at least {MIN_BEADS} of both are needed')
    if not (np.isfinite(points).all() and np.isfinite(pixels_px).all()):
        raise CalibrationError('not all positions and pixels are finite')
    T, U = _normalising(points), _normalising(pixels_px)
    X, u = _homogeneous(points) @ T.T, _homogeneous(pixels_px) @ U.T
    zero = np.zeros_like(X)
    A = np.vstack([np.hstack([X, zero, -u[:, :1] * X]), np.hstack([zero, X, -u[:, 1:2] * X])])
    _, sizes, directions = np.linalg.svd(A)
    if sizes[10] < MIN_SPREAD * sizes[0]:
        raise CalibrationError('the beads do not tell a projection: they lie (nearly) in one plane, '
                               'or too few of them do not')

    def residuals(p):
        x = X @ p.reshape(3, 4).T
        return (x[:, :2] / x[:, 2:] - u[:, :2]).ravel()
    best = least_squares(residuals, directions[-1], method='lm', x_scale='jac', xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    P = np.linalg.inv(U) @ best.reshape(3, 4) @ T
    P /= np.linalg.norm(P[2, :3])
    P *= np.sign(np.median(depth(P, points)))
    if (depth(P, points) <= 0).any():
        raise CalibrationError('the best projection has beads on both sides of the X-ray source: '
                               'beads and pixels do not belong together')
    return P


def residuals_px(P: np.ndarray, points: np.ndarray, pixels_px: np.ndarray) -> np.ndarray:
    """(N,) px between (N, 3) reprojected points in m and the (N, 2) pixels."""
    return np.linalg.norm(project(P, points) - pixels_px, axis=1)


def rms_px(residuals: np.ndarray, unknowns: int = 11) -> float:
    """Of a coordinate, from (N,) residuals of a fit with so many unknowns: what the pixels' noise was."""
    return float(np.sqrt(np.sum(residuals**2) / max(2 * len(residuals) - unknowns, 1)))


# ---- both planes


def common(a: Beads, b: Beads) -> tuple[np.ndarray, np.ndarray]:
    """(M,) indices into each of two tables of the beads that both have: at one position."""
    apart = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
    pairs = [(k, int(row.argmin())) for k, row in enumerate(apart) if row.size and row.min() < SAME]
    return tuple(np.array(pairs, int).reshape(-1, 2).T)


def triangulated_errors(a: Beads, b: Beads, P: list[np.ndarray] | None = None) -> np.ndarray:
    """(M,) m between the beads that both tables have and where they are triangulated.

    With the projections `P` of the planes, or, without, with those fitted to the beads of the other FOLDS - 1 parts:
    what to expect of a point that was no bead. NaN where these are too few to fit.
    """
    i, j = common(a, b)
    if P is not None:
        return np.linalg.norm(triangulate(P[0], P[1], a.pixels_px[i], b.pixels_px[j]) - a.points[i], axis=1)
    errors, fold = np.full(len(i), np.nan), np.arange(len(i)) % FOLDS
    for part in range(min(FOLDS, len(i))):
        out = fold == part
        try:
            fits = [projection_from_points(np.delete(t.points, k[out], axis=0), np.delete(t.pixels_px, k[out], axis=0))
                    for t, k in ((a, i), (b, j))]
        except CalibrationError:
            continue
        errors[out] = np.linalg.norm(triangulate(fits[0], fits[1], a.pixels_px[i[out]], b.pixels_px[j[out]])
                                     - a.points[i[out]], axis=1)
    return errors


def _normalising(points: np.ndarray) -> np.ndarray:
    """(d + 1, d + 1) similarity that brings (N, d) points to the origin and to a distance of sqrt(d) on average
    (HZ 4.4.4)."""
    center, d = points.mean(axis=0), points.shape[1]
    scale = np.sqrt(d) / max(np.linalg.norm(points - center, axis=1).mean(), 1e-300)
    T = np.diag([*[scale] * d, 1.0])
    T[:d, d] = -scale * center
    return T


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.c_[points, np.ones(len(points))]
