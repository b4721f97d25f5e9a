"""rosbag2 in and out (sqlite3 and MCAP, compressed or not) through the rosbags package; no ROS needed.

What a bag gives are rosbags' dataclasses, which have the attributes of the ROS messages, so that the other adapters read them.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from .messages import bag_message

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
_SUFFIXES = {'.db3': 'sqlite3'}     # every other one: mcap, as `ros2 bag record` has it


class BadBag(ValueError):
    """A bag that can't be read or written; the message names it and tells why."""


@dataclass(frozen=True)
class Recorded:
    """One message of a bag."""

    topic: str
    log_ns: int         # when it was recorded; its header says when it was taken
    message: object


class BagReader:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, reader: AnyReader):
        self._path, self._reader = path, reader

    @property
    def start_ns(self) -> int:
        """Log time of the first message."""
        return self._reader.start_time

    def types(self) -> dict[str, str]:
        """Topic to message type, of everything recorded."""
        return {c.topic: c.msgtype for c in self._reader.connections}

    def count(self, topics: Collection[str]) -> int:
        """Number of messages on `topics`."""
        return sum(c.msgcount for c in self._reader.connections if c.topic in topics)

    def messages(self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[Recorded]:
        """The messages on `topics` in the order of their log times, from `start_ns` to before `stop_ns`.

        Raises BadBag where the file is damaged, also where fewer messages come than it has by its own account.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:     # rosbags would take none for all
            return
        stream, missing = self._reader.messages(connections, start_ns, stop_ns), self.count(topics)
        while True:
            with _naming(self._path):
                entry = next(stream, None)
                if entry is None:
                    break
                connection, log_ns, raw = entry
                recorded = Recorded(connection.topic, log_ns, self._reader.deserialize(raw, connection.msgtype))
            missing -= 1
            yield recorded
        if missing and start_ns is None and stop_ns is None:
            raise BadBag(f'{self._path}: {missing} of {self.count(topics)} messages are not there')


@contextmanager
def open_bag(path) -> Iterator[BagReader]:
    """The bag at `path`, a rosbag2 directory or one of its .mcap or .db3 files. Raises BadBag."""
    path = Path(path)
    if not path.exists():
        raise BadBag(f'{path}: no such bag')
    if path.suffix == '.bag':
        raise BadBag(f'{path}: a bag of ROS 1; convert it with rosbags-convert first')
    with _naming(path):
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    try:
        yield BagReader(path, reader)
    finally:
        reader.close()


class BagWriter:
    """A bag being written, with Jazzy's types; made by `create_bag`."""

    def __init__(self, writer: Writer):
        self._writer = writer
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._connections = {}
        self.new = bag_message(self._typestore)     # makes the messages, see messages

    def declare(self, topic: str, type_name: str) -> None:
        """Have `topic` in the bag, even if nothing comes on it."""
        self._connections[topic] = self._writer.add_connection(topic, type_name, typestore=self._typestore)

    def write(self, topic: str, message, log_ns: int) -> None:
        """Append a message (made with `new`, or read from another bag) to a declared topic."""
        connection = self._connections[topic]
        self._writer.write(connection, log_ns, self._typestore.serialize_cdr(message, connection.msgtype))


@contextmanager
def create_bag(path, storage: str | None = None) -> Iterator[BagWriter]:
    """A new rosbag2 directory at `path`; `storage` is mcap or sqlite3, by default what the suffix says (.db3: sqlite3, else mcap).

    Nothing is ever overwritten, and nothing stays when it ends in an error. Raises BadBag where `path` exists, OSError where it can't be made.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise BadBag(f'{path} exists already and is not overwritten')
    writer = Writer(path, version=Writer.VERSION_LATEST, storage_plugin=STORAGES[storage or _SUFFIXES.get(path.suffix, 'mcap')])
    try:
        with writer:
            yield BagWriter(writer)
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def absolute(topic: str) -> str:
    """The name under which a relative topic is recorded without a namespace."""
    return '/' + topic.strip('/')


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Makes whatever goes wrong inside a BadBag that names the file."""
    try:
        yield
    except Exception as error:  # the last line of defence: on a damaged file rosbags raises anything from struct.error to AssertionError
        raise BadBag(f'{path}: can\'t be read as a bag ({type(error).__name__}: {" ".join(str(error).split()) or "damaged"})') from error
