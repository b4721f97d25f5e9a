"""Bags there and back in both storages, and what is wrong with damaged ones."""

import contextlib
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rosbags')

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters import salvage
from msg_adapters.bags import BadBag, absolute, create_bag, open_bag
from msg_adapters.images import array_to_image, image_to_array
from msg_adapters.messages import bag_message, stamp_ns

# of the Jazzy release, as `ros2 topic info -v` prints them
RIHS01 = {'sensor_msgs/msg/Image': 'RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47',
          'sensor_msgs/msg/CameraInfo': 'RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275'}
TOPIC = '/plane_a/image_raw'
PIXELS = np.random.default_rng(1).integers(0, 2**16, (40, 50), np.uint16)


def write(path, storage=None, stamps=(10, 20, 30)):
    with create_bag(path, storage) as bag:
        bag.declare(TOPIC, 'sensor_msgs/msg/Image')
        bag.declare('/plane_a/camera_info', 'sensor_msgs/msg/CameraInfo')
        for stamp in stamps:
            bag.write(TOPIC, array_to_image(PIXELS, stamp, 'f', bag.new), stamp + 1)
    return path


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_there_and_back(tmp_path, storage):
    with open_bag(write(tmp_path / 'run', storage)) as bag:
        assert bag.types() == {TOPIC: 'sensor_msgs/msg/Image', '/plane_a/camera_info': 'sensor_msgs/msg/CameraInfo'}
        assert (bag.count([TOPIC]), bag.count([TOPIC, '/plane_a/camera_info']), bag.start_ns) == (3, 3, 11)
        got = list(bag.messages([TOPIC, '/nothing']))
    assert [(r.topic, r.log_ns, stamp_ns(r.message)) for r in got] == [(TOPIC, 11, 10), (TOPIC, 21, 20),
                                                                       (TOPIC, 31, 30)]
    assert np.array_equal(image_to_array(got[0].message), PIXELS)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_span(tmp_path, storage):
    with open_bag(write(tmp_path / 'run', storage)) as bag:
        assert [r.log_ns for r in bag.messages([TOPIC], 12, 31)] == [21]
        assert [r.log_ns for r in bag.messages([TOPIC], 21)] == [21, 31]
        assert list(bag.messages(['/nothing'])) == []


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_without_messages(tmp_path, storage):
    with open_bag(write(tmp_path / 'run', storage, stamps=())) as bag:
        assert TOPIC in bag.types()
        assert list(bag.messages([TOPIC])) == []


@pytest.mark.parametrize('name, storage, file', [('run', None, 'run.mcap'), ('run.db3', None, 'run.db3.db3'),
                                                 ('run.db3', 'mcap', 'run.db3.mcap')])
def test_the_suffix_or_the_option_picks_the_storage(tmp_path, name, storage, file):
    assert (write(tmp_path / name, storage) / file).exists()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_types_are_those_of_jazzy(tmp_path, storage):
    text = (write(tmp_path / 'run', storage) / 'metadata.yaml').read_text()
    assert all(hash in text for hash in RIHS01.values())


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_same_content_gives_the_same_bytes(tmp_path, storage):
    first, second = (write(tmp_path / folder / 'run', storage) for folder in 'ab')
    assert {f.name: f.read_bytes() for f in first.iterdir()} == {f.name: f.read_bytes() for f in second.iterdir()}


@pytest.mark.parametrize('plugin, mode', [(StoragePlugin.SQLITE3, CompressionMode.FILE),
                                          (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
                                          (StoragePlugin.MCAP, CompressionMode.STORAGE),
                                          (StoragePlugin.MCAP, CompressionMode.FILE)])
def test_compressed_bags(tmp_path, plugin, mode):
    types = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(tmp_path / 'run', version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, 'sensor_msgs/msg/Image', typestore=types)
        writer.write(connection, 11, types.serialize_cdr(array_to_image(PIXELS, 10, 'f', bag_message(types)),
                                                         connection.msgtype))
    with open_bag(tmp_path / 'run') as bag:
        assert [np.array_equal(image_to_array(r.message), PIXELS) for r in bag.messages([TOPIC])] == [True]


def test_a_single_file_of_a_bag_will_do(tmp_path):
    with open_bag(write(tmp_path / 'run') / 'run.mcap') as bag:
        assert bag.count([TOPIC]) == 3


def test_a_copied_message_stays_the_same(tmp_path):
    with open_bag(write(tmp_path / 'run')) as bag, create_bag(tmp_path / 'copy') as out:
        out.declare(TOPIC, 'sensor_msgs/msg/Image')
        for r in bag.messages([TOPIC]):
            out.write(TOPIC, r.message, r.log_ns)
    with open_bag(tmp_path / 'copy') as bag:
        assert ([(r.log_ns, np.array_equal(image_to_array(r.message), PIXELS)) for r in bag.messages([TOPIC])]
                == [(11, True), (21, True), (31, True)])


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / 'run').mkdir()
    with pytest.raises(BadBag, match='run exists already'):
        write(tmp_path / 'run')
    assert (tmp_path / 'run').exists()


def test_nothing_stays_of_a_bag_that_ends_in_an_error(tmp_path):
    with pytest.raises(RuntimeError, match='midway'), create_bag(tmp_path / 'run') as bag:
        bag.declare(TOPIC, 'sensor_msgs/msg/Image')
        raise RuntimeError('midway')
    assert not (tmp_path / 'run').exists()


def read_all(path):
    """The stamps of what can be read, and the damage."""
    with open_bag(path) as bag:
        return [stamp_ns(r.message) for r in bag.messages([TOPIC])], bag.damage


def cut(path, kept):
    """Cut the storage file of a bag off."""
    file = next(p for p in path.iterdir() if p.suffix != '.yaml')
    file.write_bytes(file.read_bytes()[:int(kept * file.stat().st_size)])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('kept', [0.0, 0.01])
def test_a_bag_of_which_nothing_is_left_is_named(tmp_path, storage, kept):
    path = write(tmp_path / 'run', storage)
    cut(path, kept)
    with pytest.raises(BadBag, match='run: can\'t be read as a bag') as error:
        read_all(path)
    assert '\n' not in str(error.value)


LONG = range(10, 810)       # of images of 4 KB: several chunks of an MCAP file


@pytest.mark.parametrize('storage, kept', [('mcap', 0.5), ('mcap', 0.99), ('sqlite3', 0.8), ('sqlite3', 0.99)])
def test_what_is_left_of_a_truncated_bag_is_read(tmp_path, storage, kept):
    path = write(tmp_path / 'run', storage, LONG)
    cut(path, kept)
    stamps, damage = read_all(path)
    # the last chunk of 1 MB is lost
    assert stamps == list(LONG)[:len(stamps)] and 1 >= len(stamps) / len(LONG) > kept - 0.35
    assert 'run: damaged: ' in damage and '\n' not in damage


def test_a_bag_that_lost_its_metadata_is_read(tmp_path):
    """As a recording that was killed leaves it."""
    path = write(tmp_path / 'run')
    (path / 'metadata.yaml').unlink()
    stamps, damage = read_all(path)
    assert stamps == [10, 20, 30] and 'metadata' in damage


def test_a_bad_chunk_in_the_middle_costs_only_itself(tmp_path):
    path = write(tmp_path / 'run', 'mcap', LONG)
    file = path / 'run.mcap'
    data = bytearray(file.read_bytes())
    middle = data.index(b'\x05', len(data) // 2 - 4096)    # a record somewhere in the second chunk
    data[middle:middle + 300] = b'\xff' * 300
    file.write_bytes(data)
    stamps, damage = read_all(path)
    assert len(LONG) // 2 <= len(stamps) <= len(LONG) and stamps[0] == LONG[0] and stamps[-1] == LONG[-1]
    assert len(set(stamps)) == len(stamps) and damage == '' if len(stamps) == len(LONG) else damage


def test_compressed_bags_that_are_cut_off(tmp_path):
    types = get_typestore(Stores.ROS2_JAZZY)
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        path = tmp_path / mode.name
        writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection(TOPIC, 'sensor_msgs/msg/Image', typestore=types)
            for stamp in LONG[:200]:
                writer.write(connection, stamp,
                             types.serialize_cdr(array_to_image(PIXELS, stamp, 'f', bag_message(types)),
                                                 connection.msgtype))
        cut(path, 0.9)
        stamps, damage = read_all(path)
        assert stamps == list(LONG)[:len(stamps)] and len(stamps) > 10 and damage, mode


def test_what_would_take_all_memory_is_left_out(tmp_path, monkeypatch):
    """Messages that say they are longer than a limit, here one of 1 KB, when they are unpacked."""
    monkeypatch.setattr(salvage, 'SIZE_LIMIT', 1000)
    types = get_typestore(Stores.ROS2_JAZZY)
    for storage, mode in ((StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
                          (StoragePlugin.MCAP, CompressionMode.STORAGE)):
        writer = Writer(tmp_path / storage.name, version=9, storage_plugin=storage)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection(TOPIC, 'sensor_msgs/msg/Image', typestore=types)
            writer.write(connection, 11, types.serialize_cdr(array_to_image(PIXELS, 10, 'f', bag_message(types)),
                                                             connection.msgtype))
        (tmp_path / storage.name / 'metadata.yaml').unlink()
        with pytest.raises(BadBag, match='can\'t be read as a bag'):
            read_all(tmp_path / storage.name)


@pytest.mark.parametrize('line, other', [('message_count: 3', 'message_count: many'),
                                         (f'name: {TOPIC}', 'name: [1, 2]'),
                                         ('type: sensor_msgs/msg/Image', 'type: 7')])
def test_metadata_of_another_kind_are_damage(tmp_path, line, other):
    path = write(tmp_path / 'run')
    text = (path / 'metadata.yaml').read_text()
    assert line in text
    (path / 'metadata.yaml').write_text(text.replace(line, other))
    stamps, damage = read_all(path)
    assert stamps == [10, 20, 30] and damage


@pytest.mark.parametrize('rows', [
    "(1, 1, 5, x'01'), (1, 1, 6, x'02')", "('a', 1, 5, x'01'), ('b', 1, 6, x'02')", f"({2**63 - 1}, 1, 5, x'01')",
    "(1, 1, 'now', x'01'), (2, x'01', 5, 7)"])
def test_rows_that_are_none_end_nothing(tmp_path, rows):
    with contextlib.closing(sqlite3.connect(tmp_path / 'run.db3')) as database:
        database.executescript(f'''CREATE TABLE topics(id, name, type);
                                   INSERT INTO topics VALUES (1, '/a', 'b'), (2, 3, 4);
                                   CREATE TABLE messages(id, topic_id, timestamp, data);
                                   INSERT INTO messages VALUES {rows};''')
    assert len(list(salvage.sqlite_messages(tmp_path / 'run.db3'))) <= 1


@pytest.mark.parametrize('name', ['topics', 'messages'])
def test_rows_without_end_are_given_up(tmp_path, name):
    """As pages that follow one another in a circle give them; fuzz.py found such a file."""
    with contextlib.closing(sqlite3.connect(tmp_path / 'run.db3')) as database:
        database.executescript(f'''CREATE TABLE topics(id, name, type);
                                   CREATE TABLE messages(id, topic_id, timestamp, data); DROP TABLE {name};
                                   CREATE VIEW {name} AS
                                   WITH RECURSIVE same(x) AS (SELECT 0 UNION ALL SELECT 0 FROM same)
                                   SELECT x AS id, 'a' AS name, 'b' AS type, x AS topic_id, x AS timestamp,
                                          x AS data FROM same;''')
    assert not list(salvage.sqlite_messages(tmp_path / 'run.db3'))


def test_a_row_that_says_it_is_huge_is_named(tmp_path):
    """What sqlite3 raises is a MemoryError then; fuzz.py found it."""
    path = write(tmp_path / 'run', 'sqlite3')
    file = path / 'run.db3'
    data = bytearray(file.read_bytes())
    at = data.index(b'tabletopics') - 9     # in a row of sqlite_schema: before these is what lengths its columns have
    data[at:at + 6] = b'\xff' * 5 + b'e'
    file.write_bytes(data)
    with pytest.raises(BadBag, match='can\'t be read as a bag'):
        read_all(file)


def test_fewer_messages_than_announced_are_named(tmp_path):
    path = write(tmp_path / 'run')
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 3', 'message_count: 5'))
    stamps, damage = read_all(path)
    assert stamps == [10, 20, 30] and '2 of 5 messages are not there' in damage


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_with_garbage_in_it_never_ends_in_another_error(tmp_path, storage):
    path = write(tmp_path / 'run', storage)
    file = next(p for p in path.iterdir() if p.suffix != '.yaml')
    data, rng, named = file.read_bytes(), np.random.default_rng(2), 0
    for _ in range(40):
        broken = bytearray(data)
        start = rng.integers(len(data) - 64)
        broken[start:start + 64] = rng.bytes(64)
        file.write_bytes(broken)
        try:
            named += bool(read_all(path)[1])        # pixels may change unseen
        except BadBag:
            named += 1
    assert named


def test_a_full_disk_is_named(tmp_path):
    """A limit of the file size stands in for the disk's; in a process of its own, which it holds for."""
    code = ('import resource, sys\nfrom test_bags import write\nresource.setrlimit(resource.RLIMIT_FSIZE, '
            '(200_000, 200_000))\ntry:\n    write(sys.argv[1], sys.argv[2], range(10, 2010))\n'
            'except ValueError as error:\n    print(type(error).__name__, error)\n')
    for storage in ('mcap', 'sqlite3'):
        path = tmp_path / storage
        done = subprocess.run([sys.executable, '-c',
                               f'import sys\nsys.path[:0] = {[*sys.path, str(Path(__file__).parents[1])]!r}\n{code}',
                               str(path), storage],
                              capture_output=True, text=True, timeout=120)
        assert done.stdout.startswith(f'BadBag {path}: can\'t be written (') and not done.stderr, done
        assert not path.exists()


@pytest.mark.parametrize('make, says', [
    (lambda p: None, 'no such bag'),
    (lambda p: p.mkdir(), 'can\'t be read'),
    (lambda p: p.write_text('hello'), 'can\'t be read'),
    (lambda p: (p.mkdir(), (p / 'metadata.yaml').write_text('hello')), 'can\'t be read'),
    (lambda p: (p.mkdir(), (p / 'metadata.yaml').write_text('rosbag2_bagfile_information:\n  version: 99')),
     'can\'t be read'),
], ids=['missing', 'empty folder', 'text file', 'no metadata', 'from the future'])
def test_what_is_no_bag_is_named(tmp_path, make, says):
    make(tmp_path / 'run')
    with pytest.raises(BadBag, match=f'run: .*{says}'), open_bag(tmp_path / 'run'):
        pass


def test_a_bag_of_ros_1_is_named(tmp_path):
    (tmp_path / 'run.bag').write_bytes(b'#ROSBAG V2.0\n')
    with pytest.raises(BadBag, match='ROS 1'), open_bag(tmp_path / 'run.bag'):
        pass


def test_relative_topics():
    assert absolute('plane_a/image_raw') == absolute('/plane_a/image_raw') == '/plane_a/image_raw'
