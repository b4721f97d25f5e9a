"""Bags as other programs leave them: whole ones are read and not called damaged, and what is missing is said with every
failure."""

import contextlib
import re
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rosbags')

import zstandard
from drawing import GOOD
from mcap.writer import Writer as McapWriter
from recording import SECOND, main, outcomes, record
from rosbags.highlevel import AnyReader

from msg_adapters.bags import BadBag, create_bag, open_bag
from msg_adapters.images import array_to_image, image_to_array
from msg_adapters.messages import stamp_ns

TOPIC, OTHER, IMAGE = '/plane_a/image_raw', '/plane_b/image_raw', 'sensor_msgs/msg/Image'
PIXELS = np.random.default_rng(1).integers(0, 255, (40, 50), np.uint8)
STAMPS = [10, 20, 30, 40, 50]


def write(path, storage='mcap', stamps=STAMPS):
    with create_bag(path, storage) as bag:
        bag.declare(TOPIC, IMAGE)
        bag.declare(OTHER, IMAGE)
        for stamp in stamps:
            for topic in (TOPIC, OTHER):
                bag.write(topic, array_to_image(PIXELS, stamp, 'f', bag.new), stamp)
    return path


def storage_file(path):
    return next(p for p in path.iterdir() if p.suffix in ('.mcap', '.db3'))


def messages(path):
    """Topic, type, log time and CDR of all."""
    with open_bag(path) as bag:
        return [(r.topic, bag.types()[r.topic], r.log_ns, r.raw) for r in bag.messages(bag.types())]


def read(path):
    """The stamps of both topics as they come, whether the pixels are right, and the damage."""
    with open_bag(path) as bag:
        got = list(bag.messages([TOPIC, OTHER]))
        return ([(r.topic, stamp_ns(r.message)) for r in got],
                all(np.array_equal(image_to_array(r.message), PIXELS) for r in got), bag.damage)


ALL = [(topic, stamp) for stamp in STAMPS for topic in (TOPIC, OTHER)]


def edit(path, pattern, other):
    metadata = path / 'metadata.yaml'
    text, n = re.subn(pattern, other, metadata.read_text())
    assert n, pattern
    metadata.write_text(text)


def mcap(path, found, *, profile='ros2', encoding='cdr', schema_encoding='ros2msg', definition=b'', more=()):
    """Write messages (see `messages`) as an MCAP file, with what is said of them; `more` are topic, encodings and data
    of others."""
    with path.open('wb') as file:
        writer, channels = McapWriter(file), {}
        writer.start(profile=profile, library='test')
        for topic, kind, log_ns, raw in found:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding,
                                                          writer.register_schema(kind, schema_encoding, definition))
            writer.add_message(channels[topic], log_ns, raw, log_ns)
        for topic, message_encoding, other_encoding, data in more:
            channel = writer.register_channel(topic, message_encoding,
                                              writer.register_schema('some.Type', other_encoding, b'\x0a\x01x'))
            writer.add_message(channel, 15, data, 15)
        writer.finish()
    return path


# ---- whole bags


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('pattern, other', [
    (r'storage_identifier: \w+', "storage_identifier: ''"),
    (r'version: \d+', 'version: 12'),
    (r'nanoseconds: \d+', 'nanoseconds: 1'),                    # of the bag and its files
    (r'nanoseconds_since_epoch: \d+', 'nanoseconds_since_epoch: 999999999999'),
    (r'relative_file_paths:\n( *)- .*', r'relative_file_paths:\n\1- renamed_0.mcap'),
    (r'offered_qos_profiles: .*', 'offered_qos_profiles: "- history: 3\\\\n  depth: 0\\\\n  reliability: '
                                  '1\\\\n  durability: 2\\\\n  deadline: {sec: 1, nsec: 5}\\\\n  lifespan: {sec: '
                                  '1, nsec: 5}\\\\n  liveliness: 1\\\\n  liveliness_lease_duration: {sec: 1, nsec: 5}'
                                  # durations of the QoS: rosbags drops the topic without a word
                                  '\\\\n  avoid_ros_namespace_conventions: false"'),
], ids=['no storage', 'version', 'durations', 'start', 'renamed', 'qos durations'])
def test_metadata_that_others_wrote(tmp_path, storage, pattern, other):
    path = write(tmp_path / 'run', storage)
    edit(path, pattern, other)
    assert read(path) == (ALL, True, '')
    with open_bag(path) as bag:
        assert (bag.start_ns, bag.end_ns, bag.count([TOPIC])) == (10, 51, 5)


def test_metadata_kept_beside_a_file_that_was_written_anew(tmp_path):
    """Recompressed with other QoS, without indices of any kind."""
    path = write(tmp_path / 'run')
    found = messages(path)
    mcap(storage_file(path), found, definition=b'# none')
    assert read(path) == (ALL, True, '')


@pytest.mark.parametrize('padding', [b'\0' * 4, b'\0' * 8, b'\xcd' * 4])
def test_padding_after_messages(tmp_path, padding):
    found = [(*m, raw + padding) for *m, raw in messages(write(tmp_path / 'run'))]
    assert read(mcap(tmp_path / 'padded.mcap', found)) == (ALL, True, '')
    path = write(tmp_path / 'other', 'sqlite3')
    with contextlib.closing(sqlite3.connect(storage_file(path))) as database, database:
        rows = database.execute('SELECT data, id FROM messages').fetchall()
        database.executemany('UPDATE messages SET data = ? WHERE id = ?',
                             [(raw + padding, number) for raw, number in rows])
    assert read(path) == (ALL, True, '')


def test_empty_definitions_of_types_in_sqlite(tmp_path):
    path = write(tmp_path / 'run', 'sqlite3')
    with contextlib.closing(sqlite3.connect(storage_file(path))) as database, database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = ''")
    assert read(path) == (ALL, True, '')


def test_a_topic_of_another_kind_beside_ours(tmp_path):
    path = write(tmp_path / 'run')
    mcap(storage_file(path), messages(path), more=[('/foxglove', 'protobuf', 'protobuf', b'\x0a\x01x')])
    assert read(path) == (ALL, True, '')


def test_a_file_whose_profile_says_nothing(tmp_path):
    assert read(mcap(tmp_path / 'run.mcap', messages(write(tmp_path / 'run')), profile='')) == (ALL, True, '')


@pytest.mark.parametrize('renamed', [False, True])
def test_split_files_come_in_the_order_of_their_numbers(tmp_path, renamed):
    """Without metadata, or renamed beside them."""
    stamps = list(range(10, 130, 10))
    path = write(tmp_path / 'run', stamps=stamps)
    found = messages(path)
    storage_file(path).unlink()
    for k, stamp in enumerate(stamps):
        mcap(path / f'part_{k}.mcap', [m for m in found if m[2] == stamp])
    if not renamed:
        (path / 'metadata.yaml').unlink()
    order, right, damage = read(path)
    assert [stamp for topic, stamp in order if topic == TOPIC] == stamps and right and (damage == '') is renamed


def test_compressed_files_that_were_renamed(tmp_path):
    path = write(tmp_path / 'run')
    file = storage_file(path)
    (path / 'other_0.mcap.zstd').write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    file.unlink()
    assert read(path) == (ALL, True, '')


# ---- what is missing or not ours


@pytest.mark.parametrize('profile', ['ros1', ''])
def test_an_mcap_of_ros_1_is_called_so(tmp_path, capsys, profile):
    found = [(topic, 'sensor_msgs/Image', log_ns, raw[4:])
             for topic, _, log_ns, raw in messages(write(tmp_path / 'run'))]
    path = mcap(tmp_path / 'old.mcap', found, profile=profile, encoding='ros1', schema_encoding='ros1msg',
                definition=b'Header header')
    with pytest.raises(BadBag, match='old.mcap: can\'t be read as a bag .*ROS 1; convert'), open_bag(path):
        pass
    assert main(path, '--out', tmp_path / 'out') == 1
    assert 'ROS 1' in capsys.readouterr().err


def test_a_topic_of_ros_1_beside_ours(tmp_path):
    path = write(tmp_path / 'run')
    mcap(storage_file(path), messages(path), profile='', more=[('/old', 'ros1', 'ros1msg', b'1234')])
    assert read(path) == (ALL, True, '')


def test_a_file_of_several_that_is_gone_is_said(tmp_path):
    path = write(tmp_path / 'run')
    found = messages(path)
    mcap(storage_file(path), found[:6])
    stamps, right, damage = read(path)
    assert stamps == ALL[:6] and right and '4 of 10 messages are not there' in damage


def test_no_message_shows_the_name_of_a_class(tmp_path):
    path = write(tmp_path / 'run')
    for storage, kept in (('mcap', 0.6), ('sqlite3', 0.6), ('mcap', 0.001)):
        path = write(tmp_path / f'{storage}{kept}', storage, range(10, 400))
        file = storage_file(path)
        file.write_bytes(file.read_bytes()[:int(kept * file.stat().st_size)])
        try:
            said = read(path)[2]
        except BadBag as error:
            said = str(error)
        assert said and not re.search(r'\b[A-Z][a-z]+(Error|Exception)\b', said), said


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_damage_is_printed_with_every_failure(tmp_path, capsys, storage):
    """Plane A's images make no sense: that is why none pair."""
    path = record(tmp_path / 'run', [GOOD] * 2, storage)
    found = [(topic, kind, log_ns, raw[:200] if topic == TOPIC else raw) for topic, kind, log_ns, raw in messages(path)]
    if storage == 'mcap':
        mcap(storage_file(path), found)
    else:
        with contextlib.closing(sqlite3.connect(storage_file(path))) as database, database:
            database.execute('UPDATE messages SET data = substr(data, 1, 200) WHERE topic_id = '
                             '(SELECT id FROM topics WHERE name = ?)', (TOPIC,))
    assert main(path, '--out', tmp_path / 'out') == 1
    error = capsys.readouterr().err
    assert (f'a message on {TOPIC} can\'t be read as {IMAGE}' in error and '0 of plane A' in error
            and len(error.splitlines()) == 1)


def test_a_topic_that_is_announced_and_gone_is_said_with_the_failure(tmp_path, capsys):
    path = record(tmp_path / 'run', [GOOD] * 2)
    mcap(storage_file(path), [m for m in messages(path) if m[0] != TOPIC])
    assert main(path, '--out', tmp_path / 'out') == 1
    error = capsys.readouterr().err
    assert (f'{TOPIC} is not in the bag' in error and f'2 messages on {TOPIC} are announced, and none is there' in error
            and len(error.splitlines()) == 1)


def test_topics_that_were_filtered_out_of_a_bag_are_no_damage(tmp_path):
    path = write(tmp_path / 'run')
    mcap(storage_file(path), [m for m in messages(path) if m[0] == TOPIC])
    with open_bag(path) as bag:
        assert len(list(bag.messages([TOPIC]))) == 5 and bag.damage == '' and OTHER in bag.missing


def test_a_topic_that_the_summary_of_a_file_leaves_out_comes_in_its_turn(tmp_path):
    """Its index tells of one topic only: the library that reads by it knows of no other."""
    path = write(tmp_path / 'run')
    found = messages(path)
    with storage_file(path).open('wb') as file:
        writer = McapWriter(file)
        writer.start(profile='ros2', library='test')
        schema = writer.register_schema(IMAGE, 'ros2msg', b'')
        channels = {topic: writer.register_channel(topic, 'cdr', schema) for topic in (TOPIC, OTHER)}
        for topic, _, log_ns, raw in found:
            writer.add_message(channels[topic], log_ns, raw, log_ns)
        writer._Writer__finalize_chunk()
        del writer._Writer__channels[channels[TOPIC]]
        writer.finish()
    with AnyReader([storage_file(path)]) as reader:
        assert {c.topic for c in reader.connections} == {OTHER}
    assert read(path) == (ALL, True, '')


def test_a_bag_of_edited_durations_replays(tmp_path):
    path = record(tmp_path / 'run', [GOOD] * 2)
    edit(path, r'nanoseconds: \d+', 'nanoseconds: 0')
    edit(path, r'offered_qos_profiles: .*', 'offered_qos_profiles: []')
    assert main(path, '--out', tmp_path / 'out') == 0
    assert outcomes(tmp_path / 'out') == {5 * SECOND: 'ok', 5_100_000_000: 'ok'}


def test_nothing_is_left_of_what_was_unpacked(tmp_path, monkeypatch):
    monkeypatch.setenv('TMPDIR', str(tmp_path / 'tmp'))
    (tmp_path / 'tmp').mkdir()
    import tempfile
    monkeypatch.setattr(tempfile, 'tempdir', None)
    test_compressed_files_that_were_renamed(tmp_path)
    assert not list((tmp_path / 'tmp').iterdir())
    shutil.rmtree(Path(tmp_path / 'run'))
