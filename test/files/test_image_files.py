"""Image files of a plane: in what order they come, and all that a stack or a video has in it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.files.image_files import find_files, open_images, read_images
from msg_adapters.images import BadImage

STACK = np.arange(5 * 6 * 8, dtype=np.uint16).reshape(5, 6, 8) * 100


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def touch(*names):
    for name in names:
        folder = Path(name).parent
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(name, np.zeros((2, 2), np.uint8))
    return list(names)


def images(path):
    file = open_images(Path(path))
    found = list(read_images(file))
    assert len(found) == file.count
    return found


# ---- order


@pytest.mark.parametrize('names', [
    ['a/img1.png', 'a/img2.png', 'a/img10.png', 'a/img11.png', 'a/img100.png'],
    ['a/img.png', 'a/img2.png', 'a/img10.png'],
    ['a/run2_9.png', 'a/run2_10.png', 'a/run10_1.png'],
    ['a/1.png', 'a/02.png', 'a/3.png', 'a/010.png'],
    ['run2/img9.png', 'run2/img10.png', 'run10/img1.png'],
    ['a/IMG_2.png', 'a/img_10.png', 'a/Img_11.png'],
])
def test_the_numbers_decide_whoever_expands_a_pattern(names):
    """A shell hands over names in the order of its language; a quoted pattern and a folder come to us as they are."""
    touch(*names)
    as_c, as_english = sorted(names), sorted(names, key=lambda name: ''.join(filter(str.isalnum, name)).casefold())
    pattern = '*/*.png'
    for given in (as_c, as_english, [pattern], *([['a']] if names[0].startswith('a/') else ())):
        assert [str(path) for path in find_files(given)] == names, given


def test_an_order_of_ones_own_is_kept():
    names = touch('a/3.png', 'a/1.png', 'a/2.png')
    assert [str(path) for path in find_files(names)] == names


def test_a_folder_with_nothing_in_it_is_named():
    with pytest.raises(ToolError, match='none: no image files there'):
        find_files(['none'])


# ---- stacks


def imagej(path, stack, big=True, announced=None):
    """A stack as ImageJ writes those beyond 4 GB: one directory, and the images one after the other."""
    count = announced or len(stack)
    tifffile.imwrite(path, stack[0], byteorder='>' if big else '<',
                     description=f'ImageJ=1.54f\nimages={count}\nslices={count}\n', metadata=None)
    with open(path, 'ab') as file:
        file.write(stack[1:].astype(stack.dtype.newbyteorder('>' if big else '<')).tobytes())
    with tifffile.TiffFile(path) as tiff:       # the first image must be the last thing in the file
        assert len(tiff.pages) == 1 and tiff.pages[0].dataoffsets[0] + stack.nbytes == tiff.filehandle.size


@pytest.mark.parametrize('big', [True, False])
@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.float32])
def test_a_stack_with_one_directory(dtype, big):
    stack = (STACK % 251).astype(dtype)
    imagej('stack.tif', stack, big)
    found = images('stack.tif')
    assert np.array_equal(found, stack) and found[0].dtype == dtype


def test_what_imagej_writes_below_4_gb_has_a_directory_an_image():
    tifffile.imwrite('stack.tif', STACK, imagej=True)
    assert np.array_equal(images('stack.tif'), STACK)


def test_half_a_stack_is_named():
    imagej('stack.tif', STACK, announced=7)
    with pytest.raises(BadImage, match='stack.tif: a stack of 7 images of which 5 are there'):
        open_images(Path('stack.tif'))


def test_a_stack_of_which_only_a_part_can_be_read_is_named():
    """Colour, or with a directory fewer than images."""
    tifffile.imwrite('colour.tif', np.zeros((6, 8, 3), np.uint8), description='ImageJ=1.54f\nimages=4\n', metadata=None)
    with pytest.raises(BadImage, match='colour.tif: a stack of 4 images of which 1 can be read'):
        open_images(Path('colour.tif'))
    with tifffile.TiffWriter('lost.tif') as tiff:
        for k in range(3):
            tiff.write(STACK[k], description='ImageJ=1.54f\nimages=5\n' if k == 0 else '', metadata=None)
    with pytest.raises(BadImage, match='lost.tif: a stack of 5 images of which 3 can be read'):
        open_images(Path('lost.tif'))


@pytest.mark.parametrize('compression', [None, 'zlib'])
@pytest.mark.parametrize('dtype, full', [(np.uint8, 255), (np.uint16, 65535)])
def test_min_is_white_is_turned_over_whatever_the_depth(dtype, full, compression):
    stack = (STACK % 251).astype(dtype)
    tifffile.imwrite('white.tif', stack, photometric='miniswhite', compression=compression)
    assert np.array_equal(images('white.tif'), full - stack)
    tifffile.imwrite('one.tif', stack[0], photometric='miniswhite', compression=compression)
    assert np.array_equal(images('one.tif'), full - stack[:1])


def test_min_is_white_in_a_stack_with_one_directory():
    tifffile.imwrite('white.tif', STACK[0], photometric='miniswhite', description='ImageJ=1.54f\nimages=2\n',
                     metadata=None)
    with open('white.tif', 'ab') as file:
        file.write(STACK[1].tobytes())
    assert np.array_equal(images('white.tif'), 65535 - STACK[:2])


def test_garbage_in_a_tiff_never_ends_in_another_error():
    tifffile.imwrite('good.tif', STACK, imagej=True)
    data, rng = Path('good.tif').read_bytes(), np.random.default_rng(5)
    for _ in range(60):
        broken = bytearray(data)
        start = rng.integers(0, 400)
        broken[start:start + 6] = rng.bytes(6)
        Path('bad.tif').write_bytes(broken)
        try:
            images('bad.tif')
        except BadImage as error:
            assert '\n' not in str(error) and 'bad.tif' in str(error)


# ---- videos


@pytest.mark.parametrize('name, code', [('run.avi', 'MJPG'), ('run.mp4', 'mp4v')])
def test_all_frames_of_a_video_with_its_rate(name, code):
    writer = cv2.VideoWriter(name, cv2.VideoWriter_fourcc(*code), 12.5, (64, 48))
    if not writer.isOpened():
        pytest.skip(f'OpenCV has no {code} here')
    for level in (40, 90, 140, 190):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    file = open_images(Path(name))
    assert (file.count, file.rate_hz) == (4, 12.5)
    assert np.allclose([image.mean() for image in read_images(file)], [40, 90, 140, 190], atol=4)
    assert next(read_images(file)).shape == (48, 64)


def test_a_video_that_is_none_is_named():
    Path('run.avi').write_text('no video')
    with pytest.raises(BadImage, match='run.avi: not a video'):
        open_images(Path('run.avi'))
