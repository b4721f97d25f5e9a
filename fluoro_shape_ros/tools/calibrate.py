"""The projection of a plane from beads at known positions, as a calibration file: `python -m fluoro_shape_ros.tools.calibrate`.

HZ is Hartley & Zisserman, Multiple View Geometry in Computer Vision, 2nd edition.
"""

from __future__ import annotations

import argparse
import csv
import sys

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from msg_adapters.calibration import Calibration, write_calibration

from ..geometry.cameras import GeometryError, decompose, depth, make_view, project, source
from . import cli

MIN_BEADS = 6           # 11 unknowns, 2 equations a bead (HZ 7.1)
MIN_SPREAD = 0.02       # of the 11th singular value against the first: beads as flat as 1:40 leave errors of several px between them
SUSPICIOUS = 4.0        # a residual so many times the median is rather a mistaken bead than noise
UNITS = {'m': 1.0, 'mm': 1e-3}


class CalibrationError(ValueError):
    """Beads that do not tell a projection; the message says why."""


def projection_from_points(points: np.ndarray, pixels_px: np.ndarray) -> np.ndarray:
    """(3, 4) P that maps (N, 3) points in m to (N, 2) pixels with the least squared reprojection error; |P[2, :3]| = 1, all points in front.

    The direct linear transformation on normalised coordinates (HZ 7.1), then Levenberg-Marquardt on the pixels (HZ 7.2); no distortion.
    Raises CalibrationError for fewer than MIN_BEADS, values that are not finite, points (nearly) in one plane, and points on both sides of the source.
    """
    points, pixels_px = np.asarray(points, float), np.asarray(pixels_px, float)
    if len(points) != len(pixels_px) or len(points) < MIN_BEADS:
        raise CalibrationError(f'{len(points)} beads and {len(pixels_px)} pixels: at least {MIN_BEADS} of both are needed')
    if not (np.isfinite(points).all() and np.isfinite(pixels_px).all()):
        raise CalibrationError('not all positions and pixels are finite')
    T, U = _normalising(points), _normalising(pixels_px)
    X, u = _homogeneous(points) @ T.T, _homogeneous(pixels_px) @ U.T
    zero = np.zeros_like(X)
    A = np.vstack([np.hstack([X, zero, -u[:, :1] * X]), np.hstack([zero, X, -u[:, 1:2] * X])])
    _, sizes, directions = np.linalg.svd(A)
    if sizes[10] < MIN_SPREAD * sizes[0]:
        raise CalibrationError('the beads do not tell a projection: they lie (nearly) in one plane, or too few of them do not')

    def residuals(p):
        x = X @ p.reshape(3, 4).T
        return (x[:, :2] / x[:, 2:] - u[:, :2]).ravel()
    best = least_squares(residuals, directions[-1], method='lm', x_scale='jac', xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    P = np.linalg.inv(U) @ best.reshape(3, 4) @ T
    P /= np.linalg.norm(P[2, :3])
    P *= np.sign(np.median(depth(P, points)))
    if (depth(P, points) <= 0).any():
        raise CalibrationError('the best projection has beads on both sides of the X-ray source: beads and pixels do not belong together')
    return P


def residuals_px(P: np.ndarray, points: np.ndarray, pixels_px: np.ndarray) -> np.ndarray:
    """(N,) px between (N, 3) reprojected points in m and the (N, 2) pixels."""
    return np.linalg.norm(project(P, points) - pixels_px, axis=1)


def pose_arguments(P: np.ndarray, reference: str, child: str) -> str:
    """What static_transform_publisher needs to publish the pose of P's camera: frame `child` in frame `reference`."""
    _, R, _ = decompose(P)
    values = zip(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), (*source(P), *Rotation.from_matrix(R.T).as_quat()))
    return ' '.join((f'--frame-id {reference} --child-frame-id {child}', *(f'--{name} {value:.9f}' for name, value in values)))


def read_beads(path: str) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) positions in m and (N, 2) px from a CSV file with the columns x_mm, y_mm, z_mm (or x_m, y_m, z_m), u_px, v_px.

    Raises CalibrationError for missing columns and for what is no number, OSError where there is no such file.
    """
    with open(path, newline='', encoding='utf-8-sig') as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        names = [name.strip() for name in rows.fieldnames or ()]
        rows.fieldnames = names
        unit = next((unit for unit in UNITS if {f'{axis}_{unit}' for axis in 'xyz'} <= set(names)), None)
        if unit is None or not {'u_px', 'v_px'} <= set(names):
            raise CalibrationError(f'{path}: needs a first line with x_mm, y_mm, z_mm (or x_m, y_m, z_m), u_px and v_px, not {", ".join(names) or "an empty one"}')
        columns = [f'{axis}_{unit}' for axis in 'xyz'] + ['u_px', 'v_px']
        values = []
        for row in rows:
            try:
                values.append([float(row[name]) for name in columns])
            except (TypeError, ValueError):
                raise CalibrationError(f'{path}: line {rows.line_num} has something that is no number') from None
    table = np.array(values).reshape(-1, 5)
    return table[:, :3] * UNITS[unit], table[:, 3:]


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='python -m fluoro_shape_ros.tools.calibrate', description='The projection of one plane from beads at known positions, written as a camera_info YAML file.')
    parser.add_argument('beads', metavar='CSV', help='columns x_mm, y_mm, z_mm (or x_m, y_m, z_m) in the reference frame, u_px, v_px: free of distortion; a line a bead')
    parser.add_argument('--size', nargs=2, type=int, required=True, metavar=('WIDTH', 'HEIGHT'), help='of the image, px')
    parser.add_argument('--out', required=True, metavar='YAML', help='the calibration file to write')
    parser.add_argument('--name', default='', help='camera_name in the file')
    parser.add_argument('--tf', nargs=2, metavar=('REFERENCE', 'CHILD'), help='for geometry:=tf: the file holds the intrinsics only, and the pose is printed')
    return cli.run(_run, parser, argv)


def _run(args) -> None:
    cli.need('yaml', 'bags')
    try:
        points, pixels = read_beads(args.beads)
        P = make_view(args.name, projection_from_points(points, pixels), *args.size).P
    except (CalibrationError, GeometryError) as error:
        raise cli.ToolError(str(error)) from error
    K, _, _ = decompose(P)
    print('\n'.join(report(P, points, pixels)))
    write_calibration(args.out, Calibration(args.name, *args.size, K, np.c_[K, np.zeros(3)] if args.tf else P, 'plumb_bob', np.zeros(5)))
    if args.tf:
        print(f'ros2 run tf2_ros static_transform_publisher {pose_arguments(P, *args.tf)}')


def report(P: np.ndarray, points: np.ndarray, pixels_px: np.ndarray) -> list[str]:
    """What a person should compare with what is known of the system, a line each."""
    K, _, _ = decompose(P)
    r = residuals_px(P, points, pixels_px)
    rms = np.sqrt(np.sum(r**2) / max(2 * len(r) - 11, 1))
    lines = [f'{len(r)} beads, residual {rms:.3f} px rms a coordinate (11 unknowns counted), {r.max():.3f} px at worst (bead {r.argmax() + 1})',
             f'focal length {abs(K[0, 0]):.1f} px along rows, {K[1, 1]:.1f} px along columns, skew {K[0, 1]:.2f} px, principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f})',
             f'X-ray source at ({", ".join(f"{1e3 * x:.1f}" for x in source(P))}) mm, {1e3 * depth(P, points.mean(axis=0)):.1f} mm before the beads\' centre']
    if K[0, 0] < 0:
        lines.append('the image is mirrored (seen from the detector): that is fine')
    if r.max() > max(SUSPICIOUS * np.median(r), 0.5):
        lines.append(f'bead {r.argmax() + 1} fits much worse than the others: is it the right bead?')
    return lines


def _normalising(points: np.ndarray) -> np.ndarray:
    """(d + 1, d + 1) similarity that brings (N, d) points to the origin and to a distance of sqrt(d) on average (HZ 4.4.4)."""
    center, d = points.mean(axis=0), points.shape[1]
    scale = np.sqrt(d) / max(np.linalg.norm(points - center, axis=1).mean(), 1e-300)
    T = np.diag([*[scale] * d, 1.0])
    T[:d, d] = -scale * center
    return T


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.c_[points, np.ones(len(points))]


if __name__ == '__main__':
    sys.exit(main())
