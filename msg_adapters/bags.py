"""rosbag2 in and out (sqlite3 and MCAP, compressed or not) through the rosbags package; no ROS needed.

What a bag gives are rosbags' dataclasses, which have the attributes of the ROS messages, so that the other adapters read them.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from .messages import bag_message
from .salvage import Raw, Salvage

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
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
    message: object
    raw: bytes          # as it is in the bag (CDR)


class BagReader:
    """An open bag; made by `open_bag`. What is damaged is stepped over and noted in `damage`, in one line."""

    def __init__(self, path: Path, reader: AnyReader | None, damage: str = ''):
        self._path, self._reader = path, reader
        self._salvage: Salvage | None = None
        self.damage = damage
        self._typestore = _jazzy() if reader is None else reader.typestore
        if reader is not None:
            self._topics = {c.topic: (c.msgtype, 0) for c in reader.connections}
            for c in reader.connections:    # a topic has one for each QoS offered
                self._topics[c.topic] = c.msgtype, self._topics[c.topic][1] + c.msgcount
        else:
            self._topics = self._salvaged().topics

    @property
    def start_ns(self) -> int:
        """Log time of the first message."""
        return self._reader.start_time if self._reader else self._salvaged().start_ns

    @property
    def end_ns(self) -> int:
        """Just after the log time of the last message."""
        return self._reader.end_time if self._reader else self._salvaged().end_ns

    def types(self) -> dict[str, str]:
        """Topic to message type, of everything recorded."""
        return {topic: kind for topic, (kind, _) in self._topics.items()}

    def count(self, topics: Collection[str]) -> int:
        """Number of messages on `topics` by the bag's own account."""
        return sum(count for topic, (_, count) in self._topics.items() if topic in topics)

    def messages(self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[Recorded]:
        """The messages on `topics` in the order of their log times (of a damaged bag: of its files), from `start_ns` to before `stop_ns`."""
        stream, seen = self._raw_messages(topics, start_ns, stop_ns), 0
        for topic, kind, log_ns, raw in stream:
            seen += 1
            try:
                message = self._typestore.deserialize_cdr(raw, kind)
            except Exception as error:  # see open_bag: a message that makes no sense raises anything
                self._note(f'a message on {topic} can\'t be read ({type(error).__name__})')
                continue
            yield Recorded(topic, log_ns, message, raw)
        missing = self.count(topics) - seen
        if missing > 0 and (start_ns or 0) <= self.start_ns and (stop_ns is None or stop_ns >= self.end_ns):
            self._note(f'{missing} of {self.count(topics)} messages are not there')

    def close(self) -> None:
        for source in filter(None, (self._reader, self._salvage)):
            source.close()

    def _raw_messages(self, topics: Collection[str], start_ns: int | None, stop_ns: int | None) -> Iterator[Raw]:
        delivered = set()
        connections = [c for c in self._reader.connections if c.topic in topics] if self._reader else []
        if connections:     # rosbags would take none for all
            stream = self._reader.messages(connections, start_ns, stop_ns)
            try:
                for connection, log_ns, raw in stream:
                    delivered.add((connection.topic, log_ns))
                    yield connection.topic, connection.msgtype, log_ns, raw
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
            self._salvage = Salvage(self._path)
        return self._salvage

    def _note(self, what: str) -> None:
        self.damage = self.damage or f'{self._path}: damaged: {what}; what could be read was used'


@contextmanager
def open_bag(path) -> Iterator[BagReader]:
    """The bag at `path`, a rosbag2 directory or one of its .mcap or .db3 files.

    A damaged one is opened as far as it can be read, see `BagReader.damage`. Raises BadBag where that is nothing.
    """
    path = Path(path)
    if not path.exists():
        raise BadBag(f'{path}: no such bag')
    if path.suffix == '.bag':
        raise BadBag(f'{path}: a bag of ROS 1; convert it with rosbags-convert first')
    reader, reason = None, ''
    try:
        reader = _opened(path)
    except Exception as error:  # on a damaged file rosbags raises anything from struct.error to AssertionError
        reason = _reason(error)
    bag = BagReader(path, reader, reason and f'{path}: damaged: {reason}; what could be read was used')
    try:
        if not reader and not bag.types():
            raise BadBag(f'{path}: can\'t be read as a bag ({reason})')
        yield bag
    finally:
        bag.close()


def _opened(path: Path) -> AnyReader:
    reader = AnyReader([path], default_typestore=_jazzy())
    reader.open()
    if wrong := [c for c in reader.connections if not (isinstance(c.topic, str) and isinstance(c.msgtype, str) and isinstance(c.msgcount, int))]:
        reader.close()
        raise TypeError(f'topic {wrong[0].topic!r:.40} has {wrong[0].msgcount!r:.40} messages of type {wrong[0].msgtype!r:.40}')
    return reader


def _reason(error: Exception) -> str:
    """What an exception says, on one line."""
    return f'{type(error).__name__}: {" ".join(str(error).split()) or "no more is known"}'


class BagWriter:
    """A bag being written, with Jazzy's types; made by `create_bag`."""

    def __init__(self, path: Path, writer: Writer):
        self._path, self._writer = path, writer
        self._typestore = _jazzy()
        self._connections = {}
        self.new = bag_message(self._typestore)     # makes the messages, see messages

    def declare(self, topic: str, type_name: str) -> None:
        """Have `topic` in the bag, even if nothing comes on it."""
        with _written(self._path):
            self._connections[topic] = self._writer.add_connection(topic, type_name, typestore=self._typestore)

    def write(self, topic: str, message, log_ns: int) -> None:
        """Append a message (made with `new`, or read from another bag) to a declared topic. Raises BadBag where there is no room."""
        self.write_raw(topic, self._typestore.serialize_cdr(message, self._connections[topic].msgtype), log_ns)

    def write_raw(self, topic: str, raw: bytes, log_ns: int) -> None:
        """Append a message as another bag has it, see `Recorded.raw`."""
        with _written(self._path):
            self._writer.write(self._connections[topic], log_ns, raw)


@contextmanager
def create_bag(path, storage: str | None = None) -> Iterator[BagWriter]:
    """A new rosbag2 directory at `path`; `storage` is mcap or sqlite3, by default what the suffix says (.db3: sqlite3, else mcap).

    Nothing is ever overwritten, and nothing stays when it ends in an error. Raises BadBag where `path` exists or can't be written.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise BadBag(f'{path} exists already and is not overwritten')
    writer = Writer(path, version=Writer.VERSION_LATEST, storage_plugin=STORAGES[storage or _SUFFIXES.get(path.suffix, 'mcap')])
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
