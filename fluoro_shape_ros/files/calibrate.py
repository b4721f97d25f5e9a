"""fluoro_shape_calibrate: the calibration of one plane or of both, from beads at known positions or from pictures of a
board; the registration of a robot."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from msg_adapters.calibration import Calibration, write_calibration
from msg_adapters.images import BadImage

from .. import cli
from ..geometry.cameras import GeometryError, check_pair, decompose, depth, make_view, source
from ..ros.pairing import PLANES
from . import register
from .beads import (
    Beads,
    CalibrationError,
    projection_from_points,
    read_beads,
    residuals_px,
    rms_px,
    triangulated_errors,
)
from .boards import Board, calibrate_camera, find_boards, place_second
from .image_files import find_files

SUSPICIOUS = 4.0        # a residual so many times the median is rather a mistaken bead than noise
MAX_RMS = 5.0           # px; no beads are found so badly that more than mistaken ones explains it
FOCAL = 0.25, 200.0     # of the longer side of the image: from 127 degrees wide to 0.3
MAX_OBLONG = 2.0        # focal length along rows against that along columns
MAX_SKEW = 0.2          # of the focal length


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='fluoro_shape_calibrate',
        description='The calibration of one plane, or of both, as camera_info YAML files, '
                    'from beads at known positions or from pictures of a board.')
    parser.add_argument('beads', nargs='*', metavar='CSV',
                        help='a table a plane: columns x_mm, y_mm, z_mm (or x_m, y_m, z_m) in the reference frame, '
                             'u_px, v_px: free of distortion; a line a bead')
    parser.add_argument('--size', nargs='+', type=cli.count, metavar='PX',
                        help='WIDTH HEIGHT of the images, for both planes or for each; pictures have it in them')
    for plane in PLANES:
        parser.add_argument(f'--pictures-{plane}', nargs='+', metavar='FILES',
                            help=f'instead of tables: pictures of a board by plane {plane.upper()}, '
                                 'those of both planes taken together, in pairs')
    parser.add_argument('--board', nargs=2, type=cli.count, metavar=('COLUMNS', 'ROWS'),
                        help='inner corners of the chessboard, or squares of the ChArUco board')
    parser.add_argument('--square', type=cli.positive, metavar='MM', help='side of a square of the board')
    parser.add_argument('--charuco', metavar='DICTIONARY',
                        help='the board is a ChArUco board with markers of this dictionary of OpenCV, as DICT_4X4_50')
    parser.add_argument('--marker', type=cli.positive, metavar='MM', help='side of a marker of the ChArUco board')
    parser.add_argument('--register', metavar='CSV', help='instead: where a robot stands, from points that its tip was '
                                                          'led to: columns robot_x_mm, robot_y_mm, robot_z_mm '
                                                          'by its joints, x_mm, y_mm, z_mm as `tip` had them')
    parser.add_argument('--out', nargs='+', default=[], metavar='YAML',
                        help='the calibration files to write, one a plane')
    parser.add_argument('--name', nargs='+', default=[], metavar='NAME',
                        help='camera_name in the files (default: plane_a and plane_b where both are calibrated)')
    parser.add_argument('--tf', nargs='+', metavar='FRAME',
                        help='REFERENCE CHILD [CHILD], for geometry:=tf: the files hold the intrinsics only, '
                             'and the poses are printed; with --register the reference frame and the robot\'s')
    parser.add_argument('--force', action='store_true', help='overwrite the calibration files')
    return cli.run(lambda args: _run(args, parser), parser, argv)


def _run(args, parser: argparse.ArgumentParser) -> None:
    if args.register:
        if args.beads or args.out or args.size or args.pictures_a or args.pictures_b or len(args.tf or ()) != 2:
            parser.error('--register: goes with --tf REFERENCE ROBOT and nothing else')
        return _register(args)
    cli.need('yaml', 'bags')
    pictures = [getattr(args, f'pictures_{p}') for p in PLANES]
    planes = len(args.beads) or 1 + (pictures[1] is not None)
    _check_arguments(args, parser, pictures, planes)
    names = args.name or ([f'plane_{p}' for p in PLANES] if planes == 2 else [''])
    inputs = args.beads or [file for given in pictures if given for file in map(str, find_files(given))]
    _check_outputs(args.out, inputs, args.force)
    try:
        cameras, lines = _from_beads(args, names) if args.beads else _from_pictures(args, names, pictures[:planes])
    except (CalibrationError, GeometryError, BadImage) as error:
        raise cli.ToolError(str(error)) from error
    print('\n'.join(lines))
    for path, camera, child in zip(args.out, cameras, args.tf[1:] if args.tf else [None] * planes):
        K, _, _ = decompose(camera.P)
        written = Calibration(camera.camera_name, camera.width, camera.height, camera.K,
                              np.c_[K, np.zeros(3)] if child else camera.P, camera.distortion_model, camera.D)
        write_calibration(path, written)
        if child:
            print(f'ros2 run tf2_ros static_transform_publisher {pose_arguments(camera.P, args.tf[0], child)}')


def _check_arguments(args, parser: argparse.ArgumentParser, pictures: list, planes: int) -> None:
    if bool(args.beads) == bool(pictures[0]) or pictures[1] and not pictures[0] or len(args.beads) > 2:
        parser.error('one table of beads, or two, or --pictures-a, or it and --pictures-b')
    if args.beads and len(args.size or ()) not in (2, 2 * planes):
        parser.error('--size: WIDTH HEIGHT of the images is required')
    if args.beads and any((args.board, args.square, args.charuco, args.marker)) or args.size and not args.beads:
        parser.error('--board, --square, --charuco and --marker belong to pictures, --size to tables')
    if not args.beads and not (args.board and args.square) or bool(args.charuco) != bool(args.marker):
        parser.error('pictures need --board and --square, and of a ChArUco board --charuco and --marker')
    if args.board and min(args.board) < 3:
        parser.error('--board: at least 3 each way')
    if args.board and planes == 2 and not args.charuco and sum(args.board) % 2 == 0:
        parser.error('--board: one number must be odd and the other even: '
                     'such a board looks the same upside down to the planes')
    if len(args.out) != planes or len(args.name) not in (0, planes) or args.tf and len(args.tf) != planes + 1:
        parser.error('--out, --name and --tf: '
                     f'{"one file, name and child frame" if planes == 1 else "two files, names and child frames"} '
                     f'{"are" if planes == 2 else "is"} needed')


def _check_outputs(outputs: list[str], inputs: list[str], force: bool) -> None:
    """Raises ToolError before anything is computed that could not be written, or only over something else."""
    if len({Path(path).resolve() for path in outputs}) < len(outputs):
        raise cli.ToolError(f'{outputs[0]}: both planes can\'t be written to one file')
    for path in map(Path, outputs):
        if any(path.resolve() == Path(given).resolve() for given in inputs):
            raise cli.ToolError(f'{path} is what is read, and is not overwritten')
        if (path.exists() or path.is_symlink()) and not force:
            raise cli.ToolError(f'{path} exists already and is not overwritten without --force')
        if not path.parent.is_dir():
            raise cli.ToolError(f'{path}: there is no folder {path.parent}')


# ---- from beads


def _from_beads(args, names: list[str]) -> tuple[list[Calibration], list[str]]:
    """The cameras of the planes and what is to be said of them, a line each. Raises CalibrationError and
    GeometryError."""
    tables, cameras, lines = [read_beads(path) for path in args.beads], [], []
    for k, (path, name, beads) in enumerate(zip(args.beads, names, tables)):
        size = tuple(args.size[-2:] if k else args.size[:2])
        _check_inside(path, beads, size)
        try:
            P = make_view(name, projection_from_points(beads.points, beads.pixels_px), *size).P
            check_fit(P, rms_px(residuals_px(P, beads.points, beads.pixels_px)), size)
        except (CalibrationError, GeometryError) as error:
            raise CalibrationError(f'{path}: {error}') from error
        lines += [f'{name}: {line}' if len(names) > 1 else line
                  for line in report(P, beads.points, beads.pixels_px, size)]
        cameras.append(Calibration(name, size[0], size[1], decompose(P)[0], P, 'plumb_bob', np.zeros(5)))
    if len(cameras) == 2:
        lines.append(_both(tables, cameras))
    return cameras, lines


def _check_inside(path: str, beads: Beads, size: tuple[int, int]) -> None:
    """Raises CalibrationError where beads lie outside an image of this size: it is another image's."""
    outside = np.flatnonzero(((beads.pixels_px < -0.5) | (beads.pixels_px > np.array(size) - 0.5)).any(axis=1))
    if outside.size:
        u, v = beads.pixels_px[outside[0]]
        raise CalibrationError(f'{path}: {outside.size} of {len(beads.points)} beads lie outside an image of '
                               f'{size[0]}x{size[1]} px, the first is bead {outside[0] + 1} '
                               f'at ({u:.1f}, {v:.1f}): is --size right?')


def check_fit(P: np.ndarray, rms: float, size: tuple[int, int]) -> None:
    """Raises CalibrationError for a projection that can be no X-ray plane or camera with images of this size, or does
    not fit its beads."""
    K, _, _ = decompose(P)
    focal, longer = np.abs([K[0, 0], K[1, 1]]), max(size)
    if rms > MAX_RMS:
        raise CalibrationError(f'the best projection misses the beads by {rms:.1f} px rms: '
                               'beads and pixels do not belong together, in this order')
    if not (FOCAL[0] * longer < focal.min() and focal.max() < FOCAL[1] * longer):
        raise CalibrationError(f'a focal length of {focal[0]:.0f} px with images {longer} px long makes no sense: '
                               'are positions and pixels right?')
    if focal.max() > MAX_OBLONG * focal.min() or abs(K[0, 1]) > MAX_SKEW * focal.min():
        raise CalibrationError(f'focal lengths of {focal[0]:.0f} and {focal[1]:.0f} px and a skew of {K[0, 1]:.0f} px '
                               'make no sense: are positions and pixels right?')


def report(P: np.ndarray, points: np.ndarray, pixels_px: np.ndarray, size: tuple[int, int]) -> list[str]:
    """What a person should compare with what is known of the system, a line each."""
    K, _, _ = decompose(P)
    r = residuals_px(P, points, pixels_px)
    lines = [f'{len(r)} beads, residual {rms_px(r):.3f} px rms a coordinate (11 unknowns counted), '
             f'{r.max():.3f} px at worst (bead {r.argmax() + 1})',
             f'focal length {abs(K[0, 0]):.1f} px along rows, {K[1, 1]:.1f} px along columns, skew {K[0, 1]:.2f} px, '
             f'principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f})',
             f'X-ray source at ({", ".join(f"{1e3 * x:.1f}" for x in source(P))}) mm, '
             f'{1e3 * depth(P, points.mean(axis=0)):.1f} mm before the beads\' centre']
    if K[0, 0] < 0:
        lines.append('the image is mirrored (seen from the detector): that is fine')
    if r.max() > max(SUSPICIOUS * np.median(r), 0.5):
        lines.append(f'bead {r.argmax() + 1} fits much worse than the others: is it the right bead?')
    if (pixels_px.max(axis=0) < np.array(size) / 2).all():
        lines.append(f'all beads lie in the upper left quarter of {size[0]}x{size[1]} px: is --size right?')
    return lines


def _both(tables: list[Beads], cameras: list[Calibration]) -> str:
    """What the beads that are in both tables say of the planes together. Raises CalibrationError and GeometryError."""
    check_pair(tuple(make_view(p, c.P, c.width, c.height) for p, c in zip(PLANES, cameras)))
    fitted = triangulated_errors(tables[0], tables[1], [c.P for c in cameras])
    if not fitted.size:
        return 'no bead is in both tables at one position: are both in one reference frame?'
    left_out = triangulated_errors(tables[0], tables[1])
    more = (f'; {_rms_mm(left_out):.3f} mm rms where they are left out of the fit in turn'
            if not np.isnan(left_out).any() else '')
    return (f'both planes: {len(fitted)} beads triangulated, off by {_rms_mm(fitted):.3f} mm rms, '
            f'{1e3 * fitted.max():.3f} mm at worst{more}')


def _rms_mm(errors: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors**2)))


# ---- from pictures


def _from_pictures(args, names: list[str], pictures: list[list[str]]) -> tuple[list[Calibration], list[str]]:
    """The same from pictures of a board; the reference frame is the optical frame of the first plane."""
    board = Board(args.board[0], args.board[1], args.square * 1e-3, (args.marker or 0) * 1e-3, args.charuco or '')
    views = [find_boards(board, find_files(given)) for given in pictures]
    if len({len(seen.corners) for seen in views}) > 1:
        raise CalibrationError(f'{len(views[0].corners)} pictures of plane A and {len(views[1].corners)} of plane B: '
                               'they must be taken together, in pairs')
    cameras, lines = [], []
    for seen, name in zip(views, names):
        camera, rms = calibrate_camera(board, seen, name)
        check_fit(camera.P, rms, seen.size)
        K, D = camera.K, ', '.join(f'{d:.4g}' for d in camera.D)
        said = (f'{sum(map(bool, seen.corners))} of {len(seen.corners)} pictures show the board, '
                f'residual {rms:.3f} px rms a coordinate; focal length {K[0, 0]:.1f} px along rows, '
                f'{K[1, 1]:.1f} px along columns, principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}), D = ({D})')
        lines.append(f'{name}: {said}' if name else said)
        cameras.append(camera)
    if len(cameras) == 2:
        cameras[1], rms, errors = place_second(board, tuple(views), tuple(cameras))
        check_fit(cameras[1].P, rms, views[1].size)
        lines.append(f'both planes: residual {rms:.3f} px rms a coordinate, {len(errors)} corners triangulated, '
                     f'off by {_rms_mm(errors):.3f} mm rms, {1e3 * errors.max():.3f} mm at worst; '
                     f'{1e3 * np.linalg.norm(source(cameras[1].P)):.1f} mm apart; '
                     f'the reference frame is the optical frame of {names[0]}')
    return cameras, lines


# ---- for tf


def _register(args) -> None:
    try:
        robot, seen = register.read_touched(args.register)
        R, t = register.fit_pose(robot, seen)
    except CalibrationError as error:
        raise cli.ToolError(str(error) if str(error).startswith(args.register)
                            else f'{args.register}: {error}') from error
    print(register.report(robot, seen, (R, t)))
    print(f'ros2 run tf2_ros static_transform_publisher {transform_arguments(R, t, *args.tf)}')


def pose_arguments(P: np.ndarray, reference: str, child: str) -> str:
    """What static_transform_publisher needs to publish the pose of P's camera: frame `child` in frame `reference`."""
    _, R, _ = decompose(P)
    return transform_arguments(R.T, source(P), reference, child)


def transform_arguments(R: np.ndarray, t: np.ndarray, reference: str, child: str) -> str:
    """The same of a pose R (3, 3), t (3,) m of frame `child` in frame `reference`."""
    values = zip(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), (*t, *Rotation.from_matrix(R).as_quat()))
    return ' '.join((f'--frame-id {reference} --child-frame-id {child}',
                     *(f'--{name} {value:.9f}' for name, value in values)))


if __name__ == '__main__':
    sys.exit(main())
