"""fluoro_shape_import: image files and a calibration file a plane in, a bag as `ros2 bag record` would have made out."""

from __future__ import annotations

import argparse
import glob
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from msg_adapters.calibration import BadCalibration, Calibration, calibration_to_camera_info, read_calibration
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view
from msg_adapters.images import BadImage, array_to_image, grey

from ..geometry import GeometryError, check_pair
from .cli import ToolError, need, run

PLANES = ('a', 'b')
FIRST_STAMP_NS = 10**9      # a stamp of zero says nothing about time


@dataclass(frozen=True)
class Source:
    """The images of one plane in order, with their camera, whatever files they come from."""

    calibration: Calibration
    count: int
    frames: Iterable[np.ndarray]    # (H, W) uint8, uint16 or float32, read when asked for


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog='fluoro_shape_import', description='Make a bag of biplane images: image files and a camera_info YAML file a plane.')
    for plane in PLANES:
        parser.add_argument(f'--plane-{plane}', nargs='+', required=True, metavar='FILES',
                            help=f'images of plane {plane.upper()} in order of time: files, patterns, or folders (sorted by name, numbers by value)')
        parser.add_argument(f'--camera-{plane}', required=True, metavar='YAML', help=f'calibration of plane {plane.upper()}')
    parser.add_argument('--out', required=True, metavar='BAG', help='the bag to make, a new folder')
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'), help='default: sqlite3 if BAG ends in .db3, else mcap')
    times = parser.add_mutually_exclusive_group()
    times.add_argument('--rate', type=_rate, default=15.0, metavar='HZ', help='pairs per second (default: %(default)g)')
    times.add_argument('--stamps', metavar='FILE', help='text file with the time of each pair in seconds, one a line')
    parser.add_argument('--frame-ids', nargs=2, default=['plane_a_optical', 'plane_b_optical'], metavar=('A', 'B'),
                        help='frame_id of each plane (default: plane_a_optical plane_b_optical)')
    # what OpenCV (4 or 5) would say of a bad file is ours to say, in one line
    (cv2.setLogLevel if hasattr(cv2, 'setLogLevel') else cv2.utils.logging.setLogLevel)(0)
    return run(_import, parser, argv)


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.001 <= rate <= 10000:
        raise argparse.ArgumentTypeError(f'must lie in [0.001, 10000] pairs per second, not {text}')
    return rate


def _import(args) -> None:
    for module in ('rosbags.highlevel', 'mcap.stream_reader', 'yaml'):
        need(module, 'bags')
    from msg_adapters.bags import BadBag, create_bag

    try:
        sources = [image_source(find_files(getattr(args, f'plane_{p}')), read_calibration(getattr(args, f'camera_{p}'))) for p in PLANES]
        if sources[0].count != sources[1].count:
            raise ToolError(f'plane A has {sources[0].count} images, plane B {sources[1].count}: they can\'t be paired')
        stamps_ns = read_stamps(args.stamps) if args.stamps else even_stamps(args.rate, sources[0].count)
        if len(stamps_ns) != sources[0].count:
            raise ToolError(f'{args.stamps} has {len(stamps_ns)} stamps for {sources[0].count} pairs')
        with create_bag(args.out, args.storage) as bag:
            write_run(bag, sources, stamps_ns, args.frame_ids)
    except (BadCalibration, BadCameraInfo, BadImage, BadBag, GeometryError) as error:
        raise ToolError(str(error)) from error
    print(f'{sources[0].count} pairs in {args.out}')


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
    return Source(calibration, sum(pages), _read_pages(files, pages))


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


def write_run(bag, sources: list[Source], stamps_ns: list[int], frame_ids: list[str]) -> None:
    """Write both planes to `bag` (of create_bag): per pair and plane a camera info and an image with the pair's stamp.

    Raises BadImage for an image that can't be read, BadCameraInfo for a camera that can't be one or not this image's, GeometryError for
    planes that can't see depth.
    """
    for plane in PLANES:
        bag.declare(f'/plane_{plane}/camera_info', 'sensor_msgs/msg/CameraInfo')
        bag.declare(f'/plane_{plane}/image_raw', 'sensor_msgs/msg/Image')
    pairs = zip(stamps_ns, *(source.frames for source in sources))
    for stamp_ns, *images in tqdm(pairs, 'importing', len(stamps_ns), unit='pair', disable=None):
        views = []
        for plane, image, source, frame_id in zip(PLANES, images, sources, frame_ids):
            info = calibration_to_camera_info(source.calibration, stamp_ns, frame_id, bag.new)
            views.append(camera_info_to_view(info, plane, image.shape))
            bag.write(f'/plane_{plane}/camera_info', info, stamp_ns)
            bag.write(f'/plane_{plane}/image_raw', array_to_image(image, stamp_ns, frame_id, bag.new), stamp_ns)
        check_pair(tuple(views))


if __name__ == '__main__':
    sys.exit(main())
