"""fluoro_shape_import: image files and a calibration file a plane, or two DICOM XA runs, in; a bag as `ros2 bag record` would have made out."""

from __future__ import annotations

import argparse
import glob
import heapq
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import repeat
from operator import itemgetter
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from msg_adapters.calibration import BadCalibration, Calibration, calibration_to_camera_info, read_calibration
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view
from msg_adapters.images import BadImage, array_to_image, grey

from ..geometry.cameras import GeometryError, check_pair
from .cli import ToolError, need, run

PLANES = ('a', 'b')
RATE_HZ = 15.0              # where nothing tells
FIRST_STAMP_NS = 10**9      # a stamp of zero says nothing about time


@dataclass(frozen=True)
class Source:
    """The images of one plane in order, with their cameras, whatever files they come from."""

    count: int
    calibrations: Iterable[Calibration]     # one an image
    frames: Iterable[np.ndarray]            # (H, W) uint8, uint16 or float32, read when asked for
    times_ns: list[int] | None = None       # of the images; None: the files do not tell


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog='fluoro_shape_import',
                                     description='Make a bag of biplane images: image files and a camera_info YAML file a plane, or two DICOM XA runs.')
    for plane in PLANES:
        parser.add_argument(f'--plane-{plane}', nargs='+', metavar='FILES',
                            help=f'images of plane {plane.upper()} in order of time: files, patterns, or folders (sorted by name, numbers by value)')
        parser.add_argument(f'--camera-{plane}', metavar='YAML', help=f'calibration of plane {plane.upper()}')
    parser.add_argument('--dicom', nargs=2, metavar=('A', 'B'), help='the runs of both planes, instead of the above; cameras and times are in them')
    parser.add_argument('--out', required=True, metavar='BAG', help='the bag to make, a new folder')
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'), help='default: sqlite3 if BAG ends in .db3, else mcap')
    times = parser.add_mutually_exclusive_group()
    times.add_argument('--rate', type=_rate, metavar='HZ', help=f'pairs per second (default: what DICOM files say, else {RATE_HZ:g})')
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


def _import(args, parser: argparse.ArgumentParser) -> None:
    images = [getattr(args, f'{what}_{p}') for p in PLANES for what in ('plane', 'camera')]
    if args.dicom and any(images) or not args.dicom and not all(images):
        parser.error('--plane-a, --camera-a, --plane-b and --camera-b are required, or else --dicom alone')
    for module in ('rosbags.highlevel', 'mcap.stream_reader', 'yaml'):
        need(module, 'bags')
    if args.dicom:
        need('pydicom.pixels', 'dicom')
    from msg_adapters.bags import BadBag, create_bag

    from .dicom import BadDicom

    try:
        sources = dicom_sources(args.dicom) if args.dicom else [
            image_source(find_files(getattr(args, f'plane_{p}')), read_calibration(getattr(args, f'camera_{p}'))) for p in PLANES]
        if sources[0].count != sources[1].count and not args.dicom:
            raise ToolError(f'plane A has {sources[0].count} images, plane B {sources[1].count}: they can\'t be paired')
        with create_bag(args.out, args.storage) as bag:
            write_run(bag, sources, [stamps_of(source, args.rate, args.stamps) for source in sources], args.frame_ids)
    except (BadCalibration, BadCameraInfo, BadImage, BadBag, BadDicom, GeometryError) as error:
        raise ToolError(str(error)) from error
    counts = sorted({source.count for source in sources})
    print(f'{counts[0]} pairs in {args.out}' + (f' (the other plane has {counts[1]} images)' if len(counts) > 1 else ''))


def dicom_sources(paths: list[str]) -> list[Source]:
    """Planes A and B of two XA files. Raises BadDicom."""
    from .dicom import in_order, read_run
    from .dicom_pixels import pictures

    runs = in_order([read_run(path) for path in paths])
    return [Source(len(r.calibrations), r.calibrations, pictures(r), None if r.times_ns is None else (FIRST_STAMP_NS + r.times_ns).tolist()) for r in runs]


def stamps_of(source: Source, rate_hz: float | None, path: str | None) -> list[int]:
    """Stamps in ns of the images of a plane: from the file at `path`, at a rate, or as their files say. Raises ToolError."""
    if path:
        stamps_ns = read_stamps(path)
        if len(stamps_ns) != source.count:
            raise ToolError(f'{path} has {len(stamps_ns)} stamps for {source.count} pairs')
        return stamps_ns
    if rate_hz is None and source.times_ns is not None:
        return source.times_ns
    return even_stamps(rate_hz or RATE_HZ, source.count)


def find_files(patterns: list[str]) -> list[Path]:
    """The image files that `patterns` (files, folders or globs) name; within each sorted by name, numbers by value. Raises ToolError."""
    files = []
    for pattern in patterns:
        if Path(pattern).is_dir():
            found = [p for p in Path(pattern).iterdir() if p.is_file() and cv2.haveImageReader(str(p))]
        else:
            found = [Path(p) for p in ([pattern] if Path(pattern).is_file() else glob.glob(pattern)) if Path(p).is_file()]
        if not found:
            raise ToolError(f'{pattern}: no image files there')
        files += sorted(found, key=_natural)
    return files


def _natural(path: Path) -> list:
    """Sorting key: frame2 before frame10."""
    return [(int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'([0-9]+)', path.name)]


def image_source(files: list[Path], calibration: Calibration) -> Source:
    """The images in `files`, all pages of each (TIFF); their depth is kept, colour becomes grey.

    Raises BadImage where a file is no image, here or when it is read, and OSError where it can't be opened.
    """
    pages = [_count_pages(file) for file in files]
    return Source(sum(pages), repeat(calibration), _read_pages(files, pages))


def _count_pages(file: Path) -> int:
    file.open('rb').close()     # OpenCV does not tell a missing permission from a bad image
    if not cv2.haveImageReader(str(file)):
        raise BadImage(f'{file}: not an image')
    return max(cv2.imcount(str(file), cv2.IMREAD_UNCHANGED), 1)


def _read_pages(files: list[Path], pages: list[int]) -> Iterator[np.ndarray]:
    for file, count in zip(files, pages, strict=True):
        for page in range(count):
            try:
                yield grey(_read_page(str(file), page, count))
            except (cv2.error, BadImage) as error:
                raise BadImage(f'{file}: {error}') from error


def _read_page(file: str, page: int, count: int) -> np.ndarray:
    images = [cv2.imread(file, cv2.IMREAD_UNCHANGED)] if count == 1 else cv2.imreadmulti(file, page, 1, flags=cv2.IMREAD_UNCHANGED)[1]
    if not images or images[0] is None:
        raise BadImage('can\'t be read as an image')
    return images[0]


def read_stamps(path: str) -> list[int]:
    """Stamps in ns from a text file with seconds, one a line. Raises ToolError."""
    stamps = []
    for number, line in enumerate(Path(path).read_text(errors='replace').split('\n'), 1):
        if not line.strip():
            continue
        try:
            stamp = int(Decimal(line.strip()) * 10**9)      # a double has no room for the nanoseconds of today's date
        except (InvalidOperation, ValueError, OverflowError):
            raise ToolError(f'{path}, line {number}: "{line.strip()[:40]}" is no time in seconds') from None
        if not (stamps[-1] if stamps else 0) < stamp < 2**31 * 10**9:
            raise ToolError(f'{path}, line {number}: {line.strip()} s: stamps must be positive and increase')
        stamps.append(stamp)
    return stamps


def even_stamps(rate_hz: float, count: int) -> list[int]:
    """`count` stamps in ns at `rate_hz`."""
    return [FIRST_STAMP_NS + round(k * 1e9 / rate_hz) for k in range(count)]


def write_run(bag, sources: list[Source], stamps_ns: list[list[int]], frame_ids: list[str]) -> None:
    """Write both planes to `bag` (of create_bag) in the order of their stamps: with every image its camera info.

    Raises BadImage and BadDicom for an image that can't be read, BadCameraInfo for a camera that can't be one or not this image's,
    GeometryError for planes that can't see depth.
    """
    for plane in PLANES:
        bag.declare(f'/plane_{plane}/camera_info', 'sensor_msgs/msg/CameraInfo')
        bag.declare(f'/plane_{plane}/image_raw', 'sensor_msgs/msg/Image')
    views = {}
    entries = heapq.merge(*(zip(stamps, repeat(k), s.calibrations, s.frames) for k, (s, stamps) in enumerate(zip(sources, stamps_ns))), key=itemgetter(0, 1))
    for stamp_ns, k, calibration, image in tqdm(entries, 'importing', sum(map(len, stamps_ns)), unit='image', disable=None):
        plane, frame_id = PLANES[k], frame_ids[k]
        info = calibration_to_camera_info(calibration, stamp_ns, frame_id, bag.new)
        views[plane] = camera_info_to_view(info, plane, image.shape)
        bag.write(f'/plane_{plane}/camera_info', info, stamp_ns)
        bag.write(f'/plane_{plane}/image_raw', array_to_image(image, stamp_ns, frame_id, bag.new), stamp_ns)
        if len(views) == 2:
            check_pair(tuple(views[p] for p in PLANES))


if __name__ == '__main__':
    sys.exit(main())
