"""rosbag2 in and out (sqlite3 and MCAP, compressed or not) through the rosbags package; no ROS needed.

What a bag gives are rosbags' dataclasses, which have the attributes of the ROS messages, so that the other adapters
read them.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from .messages import bag_message
from .salvage import ROS_1, Raw, Salvage, plain, storage_files, unpacked

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
PADDING = range(4, 33, 4)   # bytes that a middleware may leave after a message; rosbags takes up to 3 by itself
_SUFFIXES = {'.db3': 'sqlite3'}     # every other one: mcap, as `ros2 bag record` has it


# rosbags writes and compiles code for every type of every store
_jazzy = cache(partial(get_typestore, Stores.ROS2_JAZZY))


class BadBag(ValueError):
    """A bag that can't be read or written; the message names it and tells why."""


@dataclass(frozen=True)
class Recorded:
    """One message of a bag."""

    topic: str
    log_ns: int         # when it was recorded; its header says when it was taken
    message: Any
    raw: bytes          # as it is in the bag (CDR)


class BagReader:
    """An open bag; made by `open_bag`. What is damaged is stepped over and noted in `damage`, in one line.

    `files` are its storage files, unpacked; `announced` is what metadata.yaml says: topic to the number of its
    messages. What is not there at all of it is in `missing`, in words: it may be of no interest.
    """

    def __init__(self, path: Path, files: list[Path], reader: AnyReader | None, announced: dict[str, int],
                 damage: str = ''):
        self._path, self._files, self._reader = path, files, reader
        self._salvage: Salvage | None = None
        self.damage = ''
        self._topics = self._salvaged().topics if reader is None else _counted(reader)
        less = [topic for topic, count in announced.items() if count > self._topics.get(topic, ('', 0))[1]]
        if reader is not None and any(self._salvaged().topics.get(topic, ('', 0))[1]
                                      > self._topics.get(topic, ('', 0))[1] for topic in less):
            reader.close()      # it tells of less than there is
            self._reader, self._topics = None, self._salvaged().topics
        self.missing = '; '.join(f'{announced[topic]} messages on {topic} are announced, and none is there'
                                 for topic in less if topic not in self._topics)
        self._topics = {topic: (kind, max(count, announced.get(topic, 0)))
                        for topic, (kind, count) in self._topics.items()}
        if damage:
            self._note(damage)
        elif self._reader is None and (faults := [fault for fault in self.faults if fault != ROS_1]):
            self._note(faults[0])

    @property
    def start_ns(self) -> int:
        """Log time of the first message."""
        return self._reader.start_time if self._reader else self._salvaged().start_ns

    @property
    def end_ns(self) -> int:
        """Just after the log time of the last message."""
        return self._reader.end_time if self._reader else self._salvaged().end_ns

    @property
    def faults(self) -> list[str]:
        """What was found on the way through files that rosbags does not take."""
        return self._salvage.faults if self._salvage else []

    def types(self) -> dict[str, str]:
        """Topic to message type, of everything recorded."""
        return {topic: kind for topic, (kind, _) in self._topics.items()}

    def count(self, topics: Collection[str]) -> int:
        """Number of messages on `topics` by the bag's own account."""
        return sum(count for topic, (_, count) in self._topics.items() if topic in topics)

    def messages(self, topics: Collection[str], start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[Recorded]:
        """The messages on `topics` in the order of their log times (of a damaged bag: of its files), from `start_ns` to
        before `stop_ns`."""
        stream, seen = self._raw_messages(topics, start_ns, stop_ns), 0
        for topic, kind, log_ns, raw in stream:
            seen += 1
            try:
                message = _message(raw, kind, self._reader and self._reader.typestore)
            except Exception:   # see open_bag: a message that makes no sense raises anything
                self._note(f'a message on {topic} can\'t be read as {kind}')
                continue
            yield Recorded(topic, log_ns, message, raw)
        missing = self.count(topics) - seen
        if missing > 0 and self._all_of(start_ns, stop_ns):
            self._note(f'{missing} of {self.count(topics)} messages are not there')

    def close(self) -> None:
        if self._reader:
            self._reader.close()

    def _all_of(self, start_ns: int | None, stop_ns: int | None) -> bool:
        """Whether a span is the whole bag."""
        return (start_ns or 0) <= self.start_ns and (stop_ns is None or stop_ns >= self.end_ns)

    def _raw_messages(self, topics: Collection[str], start_ns: int | None, stop_ns: int | None) -> Iterator[Raw]:
        delivered, count = set(), 0
        connections = [c for c in self._reader.connections if c.topic in topics] if self._reader else []
        if self._reader and connections:    # rosbags would take none for all
            try:
                for connection, log_ns, data in self._reader.messages(connections, start_ns, stop_ns):
                    delivered.add((connection.topic, log_ns))
                    count += 1
                    yield connection.topic, connection.msgtype, log_ns, plain(bytes(data))
                if count >= self.count(topics) or not self._all_of(start_ns, stop_ns):
                    return
            except Exception as error:  # see open_bag
                self._note(_reason(error))
        elif self._reader:
            return
        for raw in self._salvaged().messages(topics, start_ns, stop_ns):
            if (raw[0], raw[2]) not in delivered:
                yield raw

    def _salvaged(self) -> Salvage:
        if self._salvage is None:
            self._salvage = Salvage(self._files)
        return self._salvage

    def _note(self, what: str) -> None:
        self.damage = self.damage or f'{self._path}: damaged: {what}; what could be read was used'


@contextmanager
def open_bag(path: str | Path) -> Iterator[BagReader]:
    """The bag at `path`, a rosbag2 directory or one of its .mcap or .db3 files.

    A damaged one is opened as far as it can be read, see `BagReader.damage`. Raises BadBag where that is nothing.
    """
    path = Path(path)
    if not path.exists():
        raise BadBag(f'{path}: no such bag')
    if path.suffix == '.bag':
        raise BadBag(f'{path}: a bag of ROS 1; convert it with rosbags-convert first')
    reader: AnyReader | None = None
    announced: dict[str, int] = {}
    damages: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        files = [unpacked(file, Path(folder), damages.append) for file in storage_files(path)]
        try:
            announced = _announced(path / 'metadata.yaml') if path.is_dir() else {}
        except ValueError as error:
            damages.append(str(error))
        else:
            reader, reason = _opened(files)
        bag = BagReader(path, files, reader, announced, damages[0] if damages else '')
        try:
            if not reader and not bag.types():
                why = (ROS_1 + '; convert it to ROS 2 first' if ROS_1 in bag.faults else damages[0] if damages
                       else reason)
                raise BadBag(f'{path}: can\'t be read as a bag ({why})')
            yield bag
        finally:
            bag.close()


def _announced(metadata: Path) -> dict[str, int]:
    """Topic to the number of its messages, as a metadata.yaml of any version says. Raises ValueError where it makes no
    sense, in words."""
    import yaml

    try:
        topics = yaml.safe_load(
            metadata.read_text(encoding='utf-8'))['rosbag2_bagfile_information']['topics_with_message_count']
        told = [(t['topic_metadata']['name'], t['topic_metadata']['type'], t['message_count']) for t in topics or ()]
    except FileNotFoundError:
        raise ValueError('metadata.yaml is missing') from None
    except Exception:       # PyYAML raises its own, ValueError, RecursionError, and what is no mapping something else
        raise ValueError('metadata.yaml makes no sense') from None
    counts: dict[str, int] = {}
    for name, kind, count in told:
        if not (isinstance(name, str) and isinstance(kind, str) and type(count) is int and count >= 0):
            raise ValueError(f'metadata.yaml makes no sense: topic {name!r:.40} has {count!r:.40} messages of type '
                             f'{kind!r:.40}')
        counts[name] = counts.get(name, 0) + count
    return counts


def _opened(files: list[Path]) -> tuple[AnyReader | None, str]:
    """The files, without what their metadata.yaml says of them, or None and why not."""
    if not files:
        return None, 'there is no .mcap or .db3 file'
    reader = None
    try:
        reader = AnyReader(files, default_typestore=_jazzy())
        reader.open()
        if wrong := [c for c in reader.connections
                     if not (isinstance(c.topic, str) and isinstance(c.msgtype, str) and isinstance(c.msgcount, int))]:
            raise TypeError(f'topic {wrong[0].topic!r:.40} has {wrong[0].msgcount!r:.40} messages of type '
                            f'{wrong[0].msgtype!r:.40}')
    except Exception as error:  # on a damaged file rosbags raises anything from struct.error to AssertionError
        if reader is not None and reader.stack:
            reader.close()
        return None, _reason(error)
    return reader, ''


def _counted(reader: AnyReader) -> dict[str, tuple[str, int]]:
    """Topic to its type and the number of its messages."""
    topics: dict[str, tuple[str, int]] = {}
    for c in reader.connections:    # a topic has one for each QoS offered, in each file
        topics[c.topic] = c.msgtype, topics.get(c.topic, ('', 0))[1] + c.msgcount
    return topics


def _message(raw: bytes, kind: str, typestore: Any = None) -> Any:
    """A message by our own definition of its type, since those in a bag may be empty, else by that of `typestore`. What
    is more than it is padding."""
    ours = _jazzy()
    typestore = ours if kind in ours.fielddefs or typestore is None else typestore
    try:
        return typestore.deserialize_cdr(raw, kind)
    except Exception:
        for padding in PADDING:
            with suppress(Exception):
                return typestore.deserialize_cdr(raw[:-padding], kind)
        raise


def _reason(error: Exception) -> str:
    """What an exception says, on one line, without the names of classes."""
    return re.sub(r"\b\w+(Error|Exception)\b:? ?", '', ' '.join(str(error).split())) or 'its content makes no sense'


class BagWriter:
    """A bag being written, with Jazzy's types; made by `create_bag`."""

    def __init__(self, path: Path, writer: Writer):
        self._path, self._writer = path, writer
        self._typestore = _jazzy()
        self._connections: dict[str, Connection] = {}
        self.new = bag_message(self._typestore)     # makes the messages, see messages

    def declare(self, topic: str, type_name: str) -> None:
        """Have `topic` in the bag, even if nothing comes on it."""
        with _written(self._path):
            self._connections[topic] = self._writer.add_connection(topic, type_name, typestore=self._typestore)

    def write(self, topic: str, message: Any, log_ns: int) -> None:
        """Append a message (made with `new`, or read from another bag) to a declared topic. Raises BadBag where there
        is no room."""
        self.write_raw(topic, self._typestore.serialize_cdr(message, self._connections[topic].msgtype), log_ns)

    def write_raw(self, topic: str, raw: bytes | memoryview, log_ns: int) -> None:
        """Append a message as another bag has it, see `Recorded.raw`."""
        with _written(self._path):
            self._writer.write(self._connections[topic], log_ns, raw)


@contextmanager
def create_bag(path: str | Path, storage: str | None = None) -> Iterator[BagWriter]:
    """A new rosbag2 directory at `path`; `storage` is mcap or sqlite3, by default what the suffix says (.db3: sqlite3,
    else mcap).

    Nothing is ever overwritten, and nothing stays when it ends in an error. Raises BadBag where `path` exists or can't
    be written.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise BadBag(f'{path} exists already and is not overwritten')
    writer = Writer(path, version=Writer.VERSION_LATEST,
                    storage_plugin=STORAGES[storage or _SUFFIXES.get(path.suffix, 'mcap')])
    with _written(path):
        writer.open()
    try:
        yield BagWriter(path, writer)
        with _written(path):
            writer.close()
    except BaseException:
        with suppress(OSError, sqlite3.Error):
            writer.abort()
        shutil.rmtree(path, ignore_errors=True)
        raise


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Makes a full disk or a missing permission a BadBag that names the bag."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise BadBag(f'{path}: can\'t be written ({getattr(error, "strerror", None) or error})') from error


def absolute(topic: str) -> str:
    """The name under which a relative topic is recorded without a namespace."""
    return '/' + topic.strip('/')
