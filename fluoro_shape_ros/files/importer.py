"""fluoro_shape_import: image files and a calibration file a plane, or two DICOM XA runs, in; a bag as `ros2 bag record`
would have made out."""

from __future__ import annotations

import argparse
import heapq
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain, repeat
from operator import itemgetter
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from msg_adapters.calibration import BadCalibration, Calibration, calibration_to_camera_info
from msg_adapters.calibration_files import UNITS
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view, has_pose
from msg_adapters.images import BadImage, array_to_image

from ..cli import ToolError, need, run
from ..geometry.cameras import GeometryError, check_pair
from ..ros.frame_names import check_names
from ..ros.pairing import PLANES
from .image_files import find_files, natural, open_images, read_images
from .plane_cameras import read_planes, scale_notes
from .stamps import FIRST_STAMP_NS, RATE_HZ, count_pairs, even_stamps, stamps_of


@dataclass(frozen=True)
class Source:
    """The images of one plane in order, with their cameras, whatever files they come from."""

    count: int
    calibrations: Iterable[Calibration]     # one an image
    frames: Iterable[np.ndarray]            # (H, W) uint8, uint16 or float32, read when asked for
    times_ns: list[int] | None = None       # of the images; None: the files do not tell
    notes: tuple[str, ...] = ()             # what a person should know, a line each


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog='fluoro_shape_import',
                                     description='Make a bag of biplane images: image files and a camera_info YAML '
                                                 'file a plane, or two DICOM XA runs.')
    for plane in PLANES:
        parser.add_argument(f'--plane-{plane}', nargs='+', metavar='FILES',
                            help=f'images of plane {plane.upper()} in order of time: files, patterns, '
                                 'or folders (sorted by name, numbers by value); stacks and videos too')
        parser.add_argument(f'--camera-{plane}', nargs='+', metavar='FILE',
                            help=f'calibration of plane {plane.upper()}: camera_info YAML, or as XMALab, Autoscoper, '
                                 'OpenCV, MATLAB, Kalibr or ROS write it, see docs/connect.md; '
                                 'a file of both planes is given twice')
    parser.add_argument('--dicom', nargs=2, metavar=('A', 'B'),
                        help='the runs of both planes, instead of images; times are in them, '
                             'and cameras too unless given as above')
    parser.add_argument('--pixel-spacing', nargs='+', type=_spacing, metavar='MM',
                        help='of the detectors\' pixels, one for both or one a DICOM file, '
                             'where a file does not say it')
    parser.add_argument('--unit', choices=tuple(UNITS),
                        help='of lengths in the calibrations (default: what they say, else what their size tells)')
    parser.add_argument('--out', required=True, metavar='BAG', help='the bag to make, a new folder')
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'),
                        help='default: sqlite3 if BAG ends in .db3, else mcap')
    times = parser.add_mutually_exclusive_group()
    times.add_argument('--rate', type=_rate, metavar='HZ',
                       help=f'pairs per second (default: what DICOM files say, else {RATE_HZ:g})')
    times.add_argument('--stamps', metavar='FILE', help='text file with the time of each pair in seconds, one a line')
    parser.add_argument('--frame-ids', nargs=2, default=['plane_a_optical', 'plane_b_optical'], metavar=('A', 'B'),
                        help='frame_id of each plane (default: plane_a_optical plane_b_optical)')
    # what OpenCV (4 or 5) would say of a bad file is ours to say, in one line
    (cv2.setLogLevel if hasattr(cv2, 'setLogLevel') else cv2.utils.logging.setLogLevel)(0)
    return run(lambda args: _import(args, parser), parser, argv)


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.001 <= rate <= 10000:
        raise argparse.ArgumentTypeError(f'must lie in [0.001, 10000] pairs per second, not {text}')
    return rate


def _spacing(text: str) -> float:
    spacing = float(text)
    if not 1e-3 < spacing < 10:
        raise argparse.ArgumentTypeError(f'must lie between 0.001 and 10 mm, not {text}')
    return spacing


def _import(args, parser: argparse.ArgumentParser) -> None:
    images, cameras = ([getattr(args, f'{what}_{p}') for p in PLANES] for what in ('plane', 'camera'))
    if args.dicom and any(images) or not args.dicom and not all(images + cameras):
        parser.error('--plane-a, --camera-a, --plane-b and --camera-b are required, or else --dicom')
    if any(cameras) != all(cameras):
        parser.error('--camera-a and --camera-b: both, or none: those in DICOM files have their own reference frame')
    if args.pixel_spacing and (not args.dicom or any(cameras) or len(args.pixel_spacing) > 2):
        parser.error('--pixel-spacing: one or two numbers, for --dicom without --camera-a and --camera-b')
    for module in ('rosbags.highlevel', 'mcap.stream_reader', 'yaml'):
        need(module, 'bags')
    if args.dicom:
        need('pydicom.pixels', 'dicom')
    from msg_adapters.bags import BadBag, create_bag

    from .dicom_header import BadDicom

    try:
        files = [] if args.dicom else [find_files(given) for given in images]
        known, notes = read_planes(cameras, args.unit or '') if all(cameras) else ([None, None], [])
        notes += [f'plane {p.upper()}: its images are taken in the order given, which is not that of the numbers in '
                  'their names'
                  for p, found in zip(PLANES, files) if found != sorted(found, key=natural)]
        check_names(known, args.frame_ids)
        sources = dicom_sources(args, known) if args.dicom else [image_source(found, camera)
                                                                 for found, camera in zip(files, known)]
        if sources[0].count != sources[1].count and not args.dicom:
            raise ToolError(f'plane A has {sources[0].count} images, plane B {sources[1].count}: they can\'t be paired')
        stamps, guessed = stamps_of([s.count for s in sources], [s.times_ns for s in sources], args.rate, args.stamps)
        pairs, unpaired = count_pairs(stamps)
        with create_bag(args.out, args.storage) as bag:
            more, posed = write_run(bag, sources, stamps, args.frame_ids)
    except (BadCalibration, BadCameraInfo, BadImage, BadBag, BadDicom, GeometryError) as error:
        raise ToolError(str(error)) from error
    print('\n'.join([f'{pairs} pairs in {args.out}', *notes, *more, *sources[0].notes, *sources[1].notes, *guessed,
                     *unpaired]))
    if posed:
        print('results will be in the frame of the calibrations: '
              f'name it, fluoro_shape_replay {args.out} --out results -p reference_frame=isocenter', file=sys.stderr)


def dicom_sources(args, known: list[Calibration | None]) -> list[Source]:
    """Planes A and B of two XA files; `known` calibrations win over what is said there of their cameras. Raises
    BadDicom."""
    from .dicom import in_order, read_run
    from .dicom_pixels import pictures

    own, times = known[0] is not None, not (args.rate or args.stamps)
    spacings = (args.pixel_spacing or [None]) * 2
    runs = in_order([read_run(path, spacing, cameras=not own, times=times)
                     for path, spacing in zip(args.dicom, spacings)])
    cameras = map(repeat, known) if own else [r.calibrations for r in runs]
    return [Source(r.count, camera, pictures(r), None if r.times_ns is None else (FIRST_STAMP_NS + r.times_ns).tolist(),
                   r.notes)
            for r, camera in zip(runs, cameras)]


def image_source(files: list[Path], calibration: Calibration) -> Source:
    """The images in `files`, all that each has (TIFF, videos); their depth is kept, colour becomes grey.

    Raises BadImage where a file is no image, here or when it is read, and OSError where it can't be opened.
    """
    opened = [open_images(file) for file in files]
    count, rate_hz = sum(file.count for file in opened), opened[0].rate_hz if len(opened) == 1 else None
    return Source(count, repeat(calibration), chain.from_iterable(map(read_images, opened)),
                  even_stamps(rate_hz, count) if rate_hz else None)


def write_run(bag, sources: list[Source], stamps_ns: list[list[int]], frame_ids: list[str]) -> tuple[list[str], bool]:
    """Write both planes to `bag` (of create_bag) in the order of their stamps: with every image its camera info.

    Returns what is to be said of the cameras, and whether P of plane A has a pose, so that results are not in its own
    frame.

    Raises BadImage and BadDicom for an image that can't be read, BadCameraInfo for a camera that can't be one or not
    this image's, GeometryError for planes that can't see depth.
    """
    for plane in PLANES:
        bag.declare(f'/plane_{plane}/camera_info', 'sensor_msgs/msg/CameraInfo')
        bag.declare(f'/plane_{plane}/image_raw', 'sensor_msgs/msg/Image')
    views, notes, posed = {}, [], False
    entries = heapq.merge(*(zip(stamps, repeat(k), s.calibrations, s.frames)
                            for k, (s, stamps) in enumerate(zip(sources, stamps_ns))), key=itemgetter(0, 1))
    for stamp_ns, k, calibration, image in tqdm(entries, 'importing', sum(map(len, stamps_ns)), unit='image',
                                                disable=None):
        plane, frame_id = PLANES[k], frame_ids[k]
        if not calibration.width:       # its file does not say how large the images are
            calibration = replace(calibration, width=image.shape[1], height=image.shape[0])
        info = calibration_to_camera_info(calibration, stamp_ns, frame_id, bag.new)
        views[plane] = camera_info_to_view(info, plane, image.shape)
        posed |= plane == PLANES[0] and has_pose(info)
        bag.write(f'/plane_{plane}/camera_info', info, stamp_ns)
        bag.write(f'/plane_{plane}/image_raw', array_to_image(image, stamp_ns, frame_id, bag.new), stamp_ns)
        if len(views) == 2:
            pair = tuple(views[p] for p in PLANES)
            check_pair(pair)
            notes = notes or scale_notes(pair)
    return notes, posed


if __name__ == '__main__':
    sys.exit(main())
