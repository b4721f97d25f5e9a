"""What can still be read of a damaged bag: a recording that was cut off, lost its metadata.yaml,
or has bad blocks in it.

Every file is read from its begin to the first thing that makes no sense; a bad chunk (MCAP) or row (sqlite3) before
that is stepped over.
"""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import zstandard
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

STEPS, LAST_ROW = 1000, 2**63 - 1   # of sqlite3: instructions between two looks at how many it took, and the highest
                                    # number of a row
ROWS_TRIED = 256                    # damaged rows in sequence after which nothing more is to be expected
DAMAGED = sqlite3.DatabaseError, MemoryError       # what sqlite3 raises; the other one where a row says that it is huge
SIZE_LIMIT = 2**30                  # bytes; what says that it is longer is damaged, or made to take all memory
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'    # no CDR message begins like this: compressed one by one

_ROWS_AFTER = 'SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE id > ? ORDER BY id'

ROS_1 = 'its messages are those of ROS 1'

Raw = tuple[str, str, int, bytes]   # topic, type, log time in ns, CDR
Fault = Callable[[str], None]       # is told what can't be read


def _ignore(what: str) -> None:
    """Of no interest, or told before."""


class Salvage:
    """The readable messages of storage files (unpacked ones), in their order."""

    def __init__(self, files: list[Path]):
        self._files = files
        self.topics: dict[str, tuple[str, int]] = {}    # name -> type and number of readable messages
        self.faults: list[str] = []                     # what kept others from being read; empty: there are none
        times = []
        for topic, kind, log_ns, _ in self._all(self.faults.append):
            self.topics[topic] = kind, self.topics.get(topic, (kind, 0))[1] + 1
            times.append(log_ns)
        # log time of the first, and just after the last
        self.start_ns, self.end_ns = min(times, default=0), max(times, default=-1) + 1

    def messages(self, topics: Collection[str], start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[Raw]:
        """The messages on `topics` logged from `start_ns` to before `stop_ns`."""
        return (m for m in self._all() if m[0] in topics and (start_ns is None or m[2] >= start_ns)
                and (stop_ns is None or m[2] < stop_ns))

    def _all(self, fault: Fault = _ignore) -> Iterator[Raw]:
        for path in self._files:
            for topic, kind, log_ns, raw in (mcap_messages if path.suffix == '.mcap' else sqlite_messages)(path, fault):
                try:
                    yield topic, kind, log_ns, plain(raw)
                except zstandard.ZstdError:
                    fault(f'a message in {path.name} can\'t be unpacked')


def plain(raw: bytes) -> bytes:
    """A message, unpacked where it was compressed by itself. Raises ZstdError where that makes no sense, or would be
    huge."""
    if raw[:4] != ZSTD_MAGIC:
        return raw
    if zstandard.frame_content_size(raw) > SIZE_LIMIT:
        raise zstandard.ZstdError('too long')
    return zstandard.ZstdDecompressor().decompress(raw, max_output_size=SIZE_LIMIT)


def unpacked(path: Path, folder: Path, fault: Fault = _ignore) -> Path:
    """The file itself, or what comes out of a compressed one until it makes no sense, in `folder`."""
    if path.suffix != '.zstd':
        return path
    out = folder / path.stem
    try:
        with path.open('rb') as packed, out.open('wb') as plain_file:
            shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True), plain_file)
    except zstandard.ZstdError:
        fault(f'{path.name} can\'t be unpacked to its end')
    return out


def storage_files(path: Path) -> list[Path]:
    """The storage files of a bag in a folder, or the one file it is; sorted by name and number, as a recording splits
    them."""
    names = ('*.mcap', '*.db3', '*.mcap.zstd', '*.db3.zstd')
    return sorted((p for pattern in names for p in path.glob(pattern)), key=_numbered) if path.is_dir() else [path]


def _numbered(path: Path) -> list:
    """What sorts run_10 behind run_8: texts and numbers in turn."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name)]


def mcap_messages(path: Path, fault: Fault = _ignore) -> Iterator[Raw]:
    """The messages of an MCAP file in the order of the file, but those of ROS 1."""
    schemas, channels = {}, {}
    for record in _mcap_records(path, fault):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel) and record.message_encoding == 'ros1':
            fault(ROS_1)
        elif isinstance(record, Channel) and record.schema_id in schemas:
            channels[record.id] = record.topic, schemas[record.schema_id]
        elif isinstance(record, Message) and record.channel_id in channels:
            yield *channels[record.channel_id], record.log_time, record.data


def _mcap_records(path: Path, fault: Fault) -> Iterator:
    with path.open('rb') as file:
        records = StreamReader(io.BufferedReader(file), emit_chunks=True, record_size_limit=SIZE_LIMIT).records
        while True:
            try:
                record = next(records, None)
            except Exception:
                # mcap raises anything from struct.error to its own on bytes that are no record: this is where it ends
                fault(f'{path.name} ends early')
                return
            if record is None:
                return
            try:
                parts = _parts(record) if isinstance(record, Chunk) else [record]
            except Exception:       # the same inside a chunk, but the next one stands by itself
                fault(f'{path.name} has a bad block')
                continue
            yield from parts


def _parts(chunk: Chunk) -> list:
    """The records of a chunk. Raises anything where it makes no sense, or says that it is too long."""
    said = zstandard.frame_content_size(chunk.data) if chunk.compression == 'zstd' else 0
    if max(said, chunk.uncompressed_size) > SIZE_LIMIT:
        raise ValueError
    return breakup_chunk(chunk, validate_crc=True)


def sqlite_messages(path: Path, fault: Fault = _ignore) -> Iterator[Raw]:
    """The messages of a sqlite3 storage file in the order in which they were written."""
    size = path.stat().st_size
    with contextlib.closing(sqlite3.connect(f'{path.resolve().as_uri()}?immutable=1', uri=True,
                                            check_same_thread=False)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, STEPS))    # of a value: none is longer than the file
        database.set_progress_handler(_patience(size), STEPS)
        try:
            database.execute('PRAGMA writable_schema=ON')   # reads on where the file is shorter than it says
            topics = {number: (name, kind)
                      for number, name, kind in database.execute('SELECT id, name, type FROM topics')
                      if isinstance(name, str) and isinstance(kind, str)}
        except DAMAGED:
            fault(f'{path.name} has no table of topics')
            return
        number, failures = -1, 0
        while failures < ROWS_TRIED and number < LAST_ROW:
            try:
                for found, topic, log_ns, raw in database.execute(_ROWS_AFTER, (number,)):     # noqa: B020
                    if not isinstance(found, int) or found <= number:
                        fault(f'{path.name} is in disorder')
                        return      # pages in a circle
                    number, failures = found, 0
                    if topic in topics and isinstance(log_ns, int) and isinstance(raw, bytes):
                        yield *topics[topic], log_ns, raw
                return
            except DAMAGED:
                fault(f'{path.name} has bad blocks or ends early')
                number, failures = number + 1, failures + 1


def _patience(size: int) -> Callable[[], bool]:
    """What ends a query of a file of `size` bytes after more than any intact one takes: in a damaged one pages may
    follow one another without end."""
    left = iter(range(1000 + size // 100))
    return lambda: next(left, None) is None
