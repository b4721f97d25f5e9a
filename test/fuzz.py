"""Fuzz what reads bytes from elsewhere: `python test/fuzz.py TARGET --runs N`; atheris mutates messages, bags and DICOM
files that are in order.

Whatever the bytes, the reader either reads them or refuses them by its own exception. Any other one ends the run with a
traceback, exit code 77, and the bytes in a file crash-*; `python test/fuzz.py TARGET FILE` tries that again.
"""

import argparse
import gc
import sys
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import atheris

with atheris.instrument_imports(include=['msg_adapters', 'rosbags', 'pydicom', 'fluoro_shape_ros.files.dicom',
                                         'fluoro_shape_ros.files.dicom_header',
                                         'fluoro_shape_ros.files.dicom_frames', 'fluoro_shape_ros.files.dicom_geometry',
                                         'fluoro_shape_ros.files.dicom_pixels'],
                                exclude=['pydicom._dicom_dict', 'pydicom._private_dict', 'pydicom._uid_dict',
                                         'pydicom.sr']):
    import numpy as np
    from fuzz_seeds import COMPRESSED, IMAGE, INFO, PATH, TYPES, new, seeds
    from rosbags.highlevel import anyreader
    from rosbags.typesys.store import Typestore
    from rosbags.typesys.stores import empty

    from fluoro_shape_ros.config import Config
    from fluoro_shape_ros.files import dicom_pixels
    from fluoro_shape_ros.files.dicom import BadDicom, read_run
    from fluoro_shape_ros.files.dicom_pixels import pictures
    from fluoro_shape_ros.ros.message_sizes import bounded
    from fluoro_shape_ros.ros.worker import checked_camera, decode
    from msg_adapters.bags import BadBag, open_bag
    from msg_adapters.cameras import BadCameraInfo, camera_info_to_view
    from msg_adapters.images import BadImage
    from msg_adapters.shapes import BadPath, path_to_points


def message(data: bytes, kind: str):
    """The message in serialized bytes, or None where the middleware would not have delivered it."""
    try:
        return TYPES.deserialize_cdr(data, kind)
    except Exception:  # noqa: BLE001 - not ours: rosbags raises anything on damaged bytes, and BagReader answers for it
        return None


def image(data: bytes) -> None:
    msg = message(data, IMAGE)
    if msg is not None:
        check_image(msg)


def compressed_image(data: bytes) -> None:
    check_image(new(COMPRESSED, format='png', data=np.frombuffer(data, np.uint8)))


def check_image(msg) -> None:
    try:
        array = decode(bounded(msg))
    except BadImage as error:
        assert 0 < len(str(error)) < 400
    else:
        assert array.ndim == 2 and array.size and array.dtype in (np.uint8, np.uint16, np.float32)
        assert array.dtype.kind == 'u' or np.isfinite(array).all()


def camera_info(data: bytes) -> None:
    msg = message(data, INFO)
    if msg is None:
        return
    try:
        checked_camera(msg, Config())
        view = camera_info_to_view(msg, 'a', (6, 8))
    except BadCameraInfo as error:
        assert 0 < len(str(error)) < 400
    else:
        assert np.isfinite(view.P).all()


def path(data: bytes) -> None:
    msg = message(data, PATH)
    if msg is None:
        return
    try:
        points = path_to_points(msg)
    except BadPath as error:
        assert 0 < len(str(error)) < 400
    else:
        assert points.shape == (len(msg.poses), 3) and np.isfinite(points).all()


def bag(data: bytes, suffix: str) -> None:
    file = Path(SCRATCH.name) / f'bag{suffix}'
    file.write_bytes(data)
    try:
        with open_bag(file) as opened:
            for recorded in opened.messages(list(opened.types())):
                assert recorded.message is not None
    except BadBag as error:
        assert str(error)


def bag_mcap(data: bytes) -> None:
    bag(data, '.mcap')


def bag_db3(data: bytes) -> None:
    bag(data, '.db3')


def dicom(data: bytes) -> None:
    file = Path(SCRATCH.name) / 'run.dcm'
    file.write_bytes(data)
    try:
        run = read_run(file)
        assert all(np.isfinite(c.P).all() for c in run.calibrations)
        assert run.times_ns is None or run.times_ns.shape == (len(run.calibrations),)
        for frame in pictures(run):
            assert (frame.shape == (run.calibrations[0].height, run.calibrations[0].width)
                    and frame.dtype in (np.uint8, np.uint16))
    except BadDicom as error:
        assert str(error).isprintable() and len(str(error)) < 600 and 'ecret' not in str(error)


TARGETS = {f.__name__: f for f in (image, compressed_image, camera_info, path, bag_mcap, bag_db3, dicom)}
# files take ten times as long
ONE_OF = [name for name in TARGETS for _ in range(1 if name in ('bag_mcap', 'bag_db3', 'dicom') else 8)]
# of the file that is tried
SCRATCH = tempfile.TemporaryDirectory(dir='/dev/shm' if Path('/dev/shm').is_dir() else None)


def beginning(target: str) -> list[bytes]:
    """What mutations begin with."""
    return ([bytes([ONE_OF.index(name)]) + data for name in TARGETS for data in seeds(name)]
            if target == 'everything' else seeds(target))


def everything(data: bytes) -> None:
    """The first byte says which target gets the rest: a short run of all in one process."""
    if data:
        TARGETS[ONE_OF[data[0] % len(ONE_OF)]](data[1:])


class Remembered(Typestore):
    """A store of the types of a bag that shares the code made for another bag whose definitions are the same: to make
    that is 90 % of the time."""

    known: ClassVar[dict[str, Typestore]] = {}

    def register(self, typs) -> None:
        key = repr(sorted(typs.items()))
        if key not in self.known:
            super().register(typs)
            if len(self.known) < 1000:
                self.known[key] = self
        self.__dict__ = self.known.get(key, self).__dict__


def hurry() -> None:
    """Have rosbags parse and compile a definition of types once, not for every bag that has it; start no process for
    every DICOM file."""
    anyreader.get_types_from_msg = lru_cache(1000)(anyreader.get_types_from_msg)
    anyreader.get_typestore = lambda _: Remembered(empty)
    # C++, to which these mutations say little, and which may end the process
    dicom_pixels.decoded = lambda run: iter(())


def main() -> None:
    parser = argparse.ArgumentParser(prog='fuzz.py', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('target', choices=[*TARGETS, 'everything'])
    parser.add_argument('file', nargs='?', help='try the bytes of this file once, instead of fuzzing')
    parser.add_argument('--runs', type=int, default=1_000_000, help='how many executions (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of the mutations (default: %(default)s)')
    args = parser.parse_args()
    target = TARGETS.get(args.target, everything)
    if args.file:
        target(Path(args.file).read_bytes())
        return
    hurry()
    gc.freeze()
    with tempfile.TemporaryDirectory() as corpus:
        for k, data in enumerate(beginning(args.target)):
            (Path(corpus) / str(k)).write_bytes(data)
        atheris.Setup([sys.argv[0], corpus, f'-runs={args.runs}', f'-seed={args.seed}', '-max_len=65536',
                       '-rss_limit_mb=1024', '-timeout=60', '-verbosity=1'],
                      target)
        atheris.Fuzz()      # does not return


if __name__ == '__main__':
    main()
