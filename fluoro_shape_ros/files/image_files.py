"""Images of a plane in files: which ones, in what order, how many each holds, and their pixels. PNG, TIFF and what else
OpenCV reads, and videos."""

from __future__ import annotations

import glob
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import tifffile  # scikit-image needs it, so it is there

from msg_adapters.images import BadImage, check_pixels, grey

from ..cli import ToolError

VIDEOS = ('.avi', '.mp4', '.m4v', '.mov', '.mkv', '.mpg', '.mpeg', '.wmv', '.webm')
MAX_FRAMES = 10**6      # of a video or a stack: a day at 15/s


@dataclass(frozen=True)
class ImageFile:
    """A file with images."""

    path: Path
    count: int
    read: Callable[[], Iterator[np.ndarray]]    # its images in order, as OpenCV has them
    rate_hz: float | None = None                # of a video


def find_files(patterns: list[str]) -> list[Path]:
    """The image files that `patterns` (files, folders or globs) name; what one names, or a shell made of one, is sorted
    by the numbers in it. Raises ToolError."""
    if all(Path(pattern).is_file() for pattern in patterns) and _as_shells_sort(patterns):
        return sorted(map(Path, patterns), key=natural)
    files = []
    for pattern in patterns:
        if Path(pattern).is_dir():
            found = [p for p in Path(pattern).iterdir()
                     if p.is_file() and (cv2.haveImageReader(str(p)) or p.suffix.lower() in VIDEOS)]
        else:
            found = [Path(p) for p in ([pattern] if Path(pattern).is_file() else glob.glob(pattern))
                     if Path(p).is_file()]
        if not found:
            raise ToolError(f'{pattern}: no image files there')
        files += sorted(found, key=natural)
    return files


def _as_shells_sort(names: list[str]) -> bool:
    """Whether names stand in the order of their characters, or of their letters and digits alone whatever the case, as
    most languages have it."""
    return any(names == sorted(names, key=key) for key in (None, lambda name: re.sub(r'[\W_]', '', name).casefold()))


def natural(path: Path) -> tuple:
    """Sorting key: frame2 before frame10, frame before frame2, in folder run2 before run10."""
    parts = [re.split(r'([0-9]+)', part.casefold()) for part in (*path.parent.parts, path.stem, path.suffix)]
    return [[(int(run), '') if run.isdecimal() else (-1, run) for run in runs] for runs in parts], str(path)


def open_images(path: Path) -> ImageFile:
    """What images a file has. Raises BadImage where it has none, and OSError where it can't be opened."""
    path.open('rb').close()     # OpenCV does not tell a missing permission from a bad image
    if path.suffix.lower() in VIDEOS:
        return open_video(path)
    if not cv2.haveImageReader(str(path)):
        raise BadImage(f'{path}: not an image')
    count = max(cv2.imcount(str(path), cv2.IMREAD_UNCHANGED), 1)
    try:
        return _tiff(path, count) or ImageFile(path, count, partial(_read_pages, str(path), count))
    except BadImage as error:
        raise BadImage(f'{path}: {error}') from None


def read_images(file: ImageFile) -> Iterator[np.ndarray]:
    """The (H, W) images of a file; their depth is kept, colour becomes grey. Raises BadImage."""
    images = file.read()
    while True:
        try:
            if (image := next(images, None)) is None:
                return
            yield grey(image)
        except (cv2.error, BadImage) as error:
            raise BadImage(f'{file.path}: {error}') from error


def _read_pages(path: str, count: int) -> Iterator[np.ndarray]:
    for page in range(count):
        images = ([cv2.imread(path, cv2.IMREAD_UNCHANGED)] if count == 1
                  else cv2.imreadmulti(path, page, 1, flags=cv2.IMREAD_UNCHANGED)[1])
        if not images or images[0] is None:
            raise BadImage('can\'t be read as an image')
        yield images[0]


# ---- TIFF


def _tiff(path: Path, count: int) -> ImageFile | None:
    """A TIFF of `count` directories in which something else is meant than OpenCV reads; None for any other file. Raises
    BadImage for a stack that ends too soon."""
    logging.getLogger('tifffile').disabled = True
    try:
        with tifffile.TiffFile(path) as tiff:
            page, announced = tiff.pages[0], int((tiff.imagej_metadata or {}).get('images', 1))
            min_is_white, dtype, offset = (page.photometric == tifffile.PHOTOMETRIC.MINISWHITE,
                                           np.dtype(tiff.byteorder + page.dtype.char), page.dataoffsets[0])
            in_one_piece = (page.is_contiguous and page.size and page.samplesperpixel == 1
                            and dtype.newbyteorder('=') in (np.uint8, np.uint16, np.float32))
            height, width = page.shape[:2]
    except Exception:       # on a damaged file tifffile raises anything; then it is OpenCV's to read or to refuse
        return None
    if count == 1 and 1 < announced <= MAX_FRAMES and in_one_piece:
        # so ImageJ writes stacks of 4 GB and more, and others write all of theirs: one directory, and the images one
        # after the other
        check_pixels(height, width)
        there = (path.stat().st_size - offset) // (height * width * dtype.itemsize)
        if there < announced:
            raise BadImage(f'a stack of {announced} images of which {there} are there')
        return ImageFile(path, announced, partial(_read_stack, path, dtype, (height, width), offset, announced,
                                                  min_is_white))
    if announced > count:
        raise BadImage(f'a stack of {announced} images of which {count} can be read')
    if min_is_white and dtype.newbyteorder('=') == np.uint16:   # of fewer bits OpenCV turns over by itself
        return ImageFile(path, count, lambda: (65535 - image for image in _read_pages(str(path), count)))
    return None


def _read_stack(path: Path, dtype: np.dtype, shape: tuple[int, int], offset: int, count: int,
                min_is_white: bool) -> Iterator[np.ndarray]:
    with path.open('rb') as file:
        file.seek(offset)
        for _ in range(count):
            image = np.fromfile(file, dtype, shape[0] * shape[1]).reshape(shape).astype(dtype.newbyteorder('='))
            yield np.iinfo(image.dtype).max - image if min_is_white and image.dtype.kind == 'u' else image


# ---- videos


def open_video(path: Path) -> ImageFile:
    """A video by OpenCV, whose frames are counted: what containers say of that is often an estimate. Raises
    BadImage."""
    video = cv2.VideoCapture(str(path))
    try:
        rate_hz, count = video.get(cv2.CAP_PROP_FPS), 0
        while video.isOpened() and count < MAX_FRAMES and video.grab():
            count += 1
    finally:
        video.release()
    if not count:
        raise BadImage(f'{path}: not a video that OpenCV can decode here')
    return ImageFile(path, count, partial(_read_video, str(path), count),
                     rate_hz if 0.001 <= rate_hz <= 10000 else None)


def _read_video(path: str, count: int) -> Iterator[np.ndarray]:
    video = cv2.VideoCapture(path)
    try:
        for number in range(1, count + 1):
            there, image = video.read()
            if not there:
                raise BadImage(f'frame {number} of {count} can\'t be decoded')
            yield image
    finally:
        video.release()
