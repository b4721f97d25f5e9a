"""What fuzz.py begins with: messages, bags and DICOM runs that are in order, as small as can be: the fewer bytes, the
more mutations meet something."""

import contextlib
import io
import sqlite3
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pydicom
import xa
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from pydicom import uid
from pydicom.encaps import encapsulate
from rosbags.typesys import Stores, get_typestore

from msg_adapters.bags import create_bag
from msg_adapters.images import array_to_image
from msg_adapters.messages import bag_message, header

TYPES = get_typestore(Stores.ROS2_JAZZY)
IMAGE, COMPRESSED, INFO, PATH = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage',
                                 'sensor_msgs/msg/CameraInfo', 'nav_msgs/msg/Path')
HEADER = 'std_msgs/msg/Header'
new = bag_message(TYPES)
PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8)


def serialized(msg, kind: str) -> bytes:
    return bytes(TYPES.serialize_cdr(msg, kind))


def good_info():
    K = np.array([[100.0, 0, 4], [0, 100, 3], [0, 0, 1]])
    return new(INFO, header=header(new, 1, 'plane'), height=6, width=8, distortion_model='plumb_bob', d=np.zeros(5),
               k=K, r=np.eye(3), p=K @ np.eye(3, 4))


def seeds(target: str) -> list[bytes]:
    """Bytes that are in order, to begin with."""
    pictures = [PIXELS, PIXELS * np.uint16(999), PIXELS.astype(np.float32), np.dstack([PIXELS] * 3)]
    if target == 'image':
        return [*(serialized(array_to_image(p, 1, 'plane', new), IMAGE) for p in pictures), *cameras()]
    if target == 'compressed_image':
        return [cv2.imencode(suffix, p)[1].tobytes() for suffix, p in (('.png', pictures[0]), ('.png', pictures[1]),
                                                                       ('.jpg', pictures[0]), ('.jpg', pictures[3]))]
    if target == 'camera_info':
        return [serialized(good_info(), INFO)]
    if target == 'path':
        return [serialized(new(PATH, header=header(new, 1, 'cell'),
                               poses=[new('geometry_msgs/msg/PoseStamped') for _ in range(n)]), PATH) for n in (0, 3)]
    if target == 'dicom':
        return xa_runs()
    return sqlite_bags() if target == 'bag_db3' else mcap_bags()


def cameras() -> list[bytes]:
    """Images as colour cameras send them: four channels, colour for two pixels at a time, colour below the luminance;
    big-endian with padded rows."""
    # encoding, step, rows of data
    kinds = [('bgra8', 32, 6), ('yuv422', 16, 6), ('yuv422_yuy2', 16, 6), ('nv12', 8, 9), ('mono16', 18, 6)]
    return [serialized(new(IMAGE, header=header(new, 1, 'plane'), height=6, width=8, encoding=encoding,
                           is_bigendian=int(encoding == 'mono16'), step=step,
                           data=np.arange(step * rows, dtype=np.uint8)), IMAGE) for encoding, step, rows in kinds]


def sqlite_bags() -> list[bytes]:
    """A bag as rosbags writes it, on pages of 512 bytes."""
    with tempfile.TemporaryDirectory() as folder:
        with create_bag(Path(folder) / 'bag', 'sqlite3') as out:
            out.declare('/header', HEADER)
            out.write('/header', header(new, 1, 'plane'), 5)
        file = next((Path(folder) / 'bag').glob('*.db3'))
        with contextlib.closing(sqlite3.connect(file)) as database:
            database.execute('PRAGMA page_size=512')
            database.execute('VACUUM')
        return [file.read_bytes()]


def mcap_bags() -> list[bytes]:
    """Bags with an index and without, chunks of every compression, without definitions, of ROS 1; no checksums, which
    would refuse every mutation before it is read."""
    definition, found = TYPES.generate_msgdef(HEADER, ros_version=2)[0].encode(), []
    kinds = [*((dict(compression=kind), definition, 'cdr') for kind in CompressionType),
             (dict(use_chunking=False), definition, 'cdr'),
             (dict(index_types=IndexType.NONE, use_statistics=False), definition, 'cdr'),
             (dict(use_chunking=False), b'', 'cdr'), (dict(use_chunking=False), b'', 'ros1')]
    for options, text, encoding in kinds:
        file = io.BytesIO()
        writer = McapWriter(file, enable_crcs=False, enable_data_crcs=False, **options)
        writer.start('ros2')
        schema = writer.register_schema(HEADER, 'ros1msg' if encoding == 'ros1' else 'ros2msg', text)
        channel = writer.register_channel('/header', encoding, schema)
        writer.add_message(channel, 5, serialized(header(new, 1, 'plane'), HEADER), 5)
        writer.finish()
        found.append(file.getvalue())
    return found


def xa_runs() -> list[bytes]:
    """Runs with all that is read of a header, in every way to write one that is read, and every compression that can be
    made here."""
    deep = np.stack([PIXELS, PIXELS * 5]).astype(np.uint16) << 4
    moving = dict(PositionerPrimaryAngleIncrement=[0, 5], FrameTimeVector=[0, 60], FrameIncrementPointer=0x00181065,
                  PatientOrientation=['L', 'F'])
    signed = dict(BitsStored=12, HighBit=15, PixelRepresentation=1, PhotometricInterpretation='MONOCHROME1',
                  ImageType=['ORIGINAL', 'PRIMARY', 'BIPLANE B'])
    large = np.tile(PIXELS, (6, 4))     # JPEG 2000 halves it five times
    jpeg, jpeg_2000 = (cv2.imencode(suffix, large)[1].tobytes() for suffix in ('.jpg', '.jp2'))
    # without the file around it
    encoded = {uid.JPEGBaseline8Bit: jpeg, uid.JPEG2000Lossless: jpeg_2000[jpeg_2000.index(b'\xff\x4f\xff\x51'):]}
    found = [xa.make(io.BytesIO(), deep, **moving, **signed),
             xa.make(io.BytesIO(), deep, syntax=uid.ImplicitVRLittleEndian, FrameTime=None, CineRate=8),
             xa.make(io.BytesIO(), PIXELS[None], **xa.logarithms()),
             *(xa.make(io.BytesIO(), large[None], syntax=syntax, pixel_data=encapsulate([frame]))
               for syntax, frame in encoded.items())]
    packed = pydicom.dcmread(io.BytesIO(found[0].getvalue()))
    packed.compress(uid.RLELossless)
    packed.save_as(file := io.BytesIO())
    found += [file, xa.enhanced(io.BytesIO(), deep, [0.0, 5.0], [0.1, 0.2], PlaneIdentification='PLANE A')]
    return [*(file.getvalue() for file in found), found[1].getvalue()[132:]]       # the last one without preamble
