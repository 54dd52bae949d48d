"""Read a bag (ROS 1 files, ROS 2 folders, single MCAP or SQLite files) by its address with options."""

from __future__ import annotations

import re
import struct
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from gausslite.domain.errors import DatasetError
from gausslite_ros.bag_parts import SUFFIXES, foreign_part, has_bag, is_bag, missing_parts, open_parts, repair_of
from gausslite_ros.mcap_file import Message

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


_CHOICES = {"aligned": ("yes", "no"), "axes": ("optical", "body")}
_QUANTITIES = {
    "depth_unit": ("depth_unit_m", re.compile(r"([0-9]{1,4}(?:\.[0-9]{1,9})?)(mm|m)")),
    "tolerance": ("tolerance_s", re.compile(r"([0-9]{1,4}(?:\.[0-9]{1,3})?)(ms)")),
}
"""Options with a unit, the field that holds each in metres or seconds, and its form."""


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Topics and frames of a bag, as written in its address; an empty text leaves the choice to the reader.

    color, depth: image topics. color_info, depth_info: their camera_info topics. camera_file: a file that states the
    colour camera instead, as in folders. aligned: "yes" or "no", whether depth belongs to the colour pixels.
    depth_unit_m: metres per unit of depth, 0: as its topic states. odom: a topic with poses, used instead
    of tf. body: the frame whose pose that topic states. tf, tf_static: topics of tf. frame: the world frame in tf.
    camera: the colour camera's frame. axes: "optical" (z forward) or "body" (x forward), the convention of the camera
    frames. tolerance_s: largest difference of the stamps of a colour and a depth image.
    """

    color: str = ""
    depth: str = ""
    color_info: str = ""
    depth_info: str = ""
    camera_file: str = ""
    aligned: str = ""
    depth_unit_m: float = 0.0
    odom: str = ""
    body: str = ""
    tf: str = ""
    tf_static: str = ""
    frame: str = ""
    camera: str = ""
    axes: str = "optical"
    tolerance_s: float = 0.020


@dataclass(frozen=True, slots=True)
class BagAddress:
    """Where a bag is, and how to read it."""

    path: Path
    options: BagOptions = BagOptions()

    @classmethod
    def parse(cls, address: str) -> BagAddress:
        """Return the address of "PATH?color=TOPIC&...".

        Raises DatasetError for unknown options, and if there is no bag.
        """
        path, query = _path_and_query(address)
        if not (has_bag(path) or is_bag(path)):
            raise DatasetError(f"{address}: {_reason(path)}")
        return cls(path, _parse_options(address, query))


def is_bag_address(address: str) -> bool:
    """True for the path of a bag, with or without options; a folder with other files too is none."""
    return is_bag(_path_and_query(address)[0])


def _path_and_query(address: str) -> tuple[Path, str]:
    name, _, query = address.partition("?")
    if Path(address).expanduser().exists():
        # a name may have a question mark
        name, query = address, ""
    return Path(name).expanduser(), query


def _reason(path: Path) -> str:
    expected = f"expected a bag: a file {', '.join('*' + suffix for suffix in SUFFIXES)}, or a folder with such files"
    if path.is_dir():
        return f"{expected}; got a folder without them"
    return f"{expected}; got {'a file ' + path.name if path.exists() else 'nothing there'}"


def _parse_options(address: str, query: str) -> BagOptions:
    with_form = (*_CHOICES, *(field for field, _ in _QUANTITIES.values()))
    names = [field.name for field in fields(BagOptions) if field.name not in with_form]
    chosen: dict[str, Any] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        name, form = _QUANTITIES.get(key, (key, None))
        quantity = form.fullmatch(value) if form else None
        if quantity:
            chosen[name] = float(quantity[1]) / (1 if quantity[2] == "m" else 1000)
        elif (key in names and value) or value in _CHOICES.get(key, ()):
            chosen[key] = value
        else:
            choices = (f"{name}={'|'.join(values)}" for name, values in _CHOICES.items())
            expected = "&".join([*(f"{name}=..." for name in names), *choices, "depth_unit=Xmm", "tolerance=Xms"])
            raise DatasetError(f"{address}: {key}={value}: expected {expected}, each optional")
    return BagOptions(**chosen)


_TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_ALIASES = {"tf/msg/tfMessage": _TF_MESSAGE}
_STAMP_END = 12
"""Bytes of a serialised message before what follows the stamp of its header, in ROS 1 and in ROS 2."""
_ZSTD = b"\x28\xb5\x2f\xfd"
_SERIALISATIONS = ("ros1", "cdr")
_MAX_LATE_NS = 1_500_000_000
"""A message whose stamp is older than the newest one by more was recorded after the clock had been set back."""
_STAMP_ROS1, _STAMP_ROS2 = struct.Struct("<4xII"), (struct.Struct(">4xiI"), struct.Struct("<4xiI"))


@dataclass(frozen=True, slots=True)
class MessageKey:
    """Where a message is in a bag: topic, part of the recording, time of recording, and rank among equal times."""

    topic: str
    part: int
    recorded_ns: int
    rank: int


@dataclass(frozen=True, slots=True)
class StampedMessage:
    """A message by its position in the bag and the stamp of its header."""

    key: MessageKey
    stamp_ns: int


class _Clock:
    """Raises DatasetError for a stamp of before the clock was set back; a single stamp of the future does no harm."""

    def __init__(self, location: str) -> None:
        self._location = location
        self._newest_ns = self._before_ns = -_MAX_LATE_NS

    def add(self, stamp_ns: int) -> None:
        """Compare the next stamp in the order of recording."""
        newest_ns = self._newest_ns
        if stamp_ns < newest_ns - _MAX_LATE_NS:
            if stamp_ns < self._before_ns - _MAX_LATE_NS:
                raise DatasetError(
                    f"{self._location}: expected one run, got stamps that go back from {newest_ns / 1e9:.1f} to "
                    f"{stamp_ns / 1e9:.1f} s, as in a playback in a loop, a reset of a simulator or several recordings"
                )
            self._newest_ns = self._before_ns
        if stamp_ns > self._newest_ns:
            self._before_ns, self._newest_ns = self._newest_ns, stamp_ns


class BagFile:
    """An opened bag with random access to its messages, from any thread.

    Only the types of topics that are read are defined, so that a damaged definition of another type does no harm.
    Raises DatasetError for a bag that cannot be read, and without the extra `ros`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stores: dict[str, Typestore] = {}
        # the readers share the position in their file between all messages
        self._reading = RLock()
        with self._readable():
            self._parts = open_parts(path)
            for part in self._parts:
                weakref.finalize(self, part.close)
            self._connections: dict[str, list[tuple[int, Connection]]] = {}
            self._foreign: dict[str, str] = {}
            for number, part in enumerate(self._parts):
                for connection in part.connections:
                    serialisation = _serialisation(connection)
                    if serialisation in _SERIALISATIONS:
                        self._connections.setdefault(connection.topic, []).append((number, connection))
                    else:
                        self._foreign[connection.topic] = f"{connection.msgtype} as {serialisation}"

    @property
    def path(self) -> Path:
        """File or folder of the bag."""
        return self._path

    @property
    def notes(self) -> list[str]:
        """Messages on parts that are not whole, or not there."""
        notes = [getattr(part, "note", "") for part in self._parts]
        return [note for note in (*notes, missing_parts(self._path)) if note]

    @property
    def types(self) -> dict[str, str]:
        """Message type of each topic, such as sensor_msgs/msg/Image, sorted by topic; topics without messages too.

        Topics of other serialisations than those of ROS 1 and ROS 2 are there with its name, and cannot be read.
        """
        readable = {topic: _type_of(found[0][1]) for topic, found in self._connections.items()}
        return dict(sorted((self._foreign | readable).items()))

    def first(self, topic: str) -> Any | None:
        """Return the first message of a topic; None if it has none. Raises DatasetError."""
        return next(self.messages(topic), None)

    def contents(self, topic: str) -> list[tuple[int, Any]]:
        """Return the messages of a topic that differ from the one before in more than their stamps, with the stamps.

        Raises DatasetError.
        """
        found: list[tuple[int, Any]] = []
        before = None
        with self._readable(topic):
            for _, connection, time_ns, data in self._serialised(topic):
                if data[_STAMP_END:] != before:
                    before = data[_STAMP_END:]
                    stamp_ns = _header_stamp_ns(data, _is_ros1(connection)) or time_ns
                    found.append((stamp_ns, self._deserialise(connection, data)))
        return found

    def messages(self, topic: str) -> Iterator[Any]:
        """Yield all messages of a topic in the order of recording. Raises DatasetError."""
        with self._readable(topic):
            for _, connection, _, data in self._serialised(topic):
                yield self._deserialise(connection, data)

    def stamps(self, topic: str) -> list[StampedMessage]:
        """Return all messages of a topic by the stamps of their headers, ascending.

        A header without a stamp counts from the time when the message was recorded. Payloads are not decoded. Raises
        DatasetError, also if the clock was set back: poses of two runs would stand at one time.
        """
        found: list[StampedMessage] = []
        last, rank = (-1, -1), 0
        clock = _Clock(f"{self._path}: {topic}")
        with self._readable(topic):
            for part, connection, time_ns, data in self._serialised(topic):
                rank = rank + 1 if (part, time_ns) == last else 0
                last = part, time_ns
                if stamp_ns := _header_stamp_ns(data, _is_ros1(connection)):
                    clock.add(stamp_ns)
                found.append(StampedMessage(MessageKey(topic, part, time_ns, rank), stamp_ns or time_ns))
        return sorted(found, key=lambda message: message.stamp_ns)

    def read(self, key: MessageKey) -> Any:
        """Return one message. Raises DatasetError."""
        start_ns = key.recorded_ns
        with self._readable(key.topic):
            wanted = [connection for part, connection in self._connections[key.topic] if part == key.part]
            at_time = self._one_by_one(self._parts[key.part].messages(wanted, start_ns, start_ns + 1))
            for rank, (connection, _, data) in enumerate(at_time):
                if rank == key.rank:
                    return self._deserialise(connection, data)
        raise DatasetError(f"{self._path}: {key.topic}: expected a message at {start_ns} ns, got none")

    def _serialised(self, topic: str) -> Iterator[tuple[int, Connection, int, bytes]]:
        """Yield part, connection, time of recording and serialised message of a topic."""
        for number, part in enumerate(self._parts):
            wanted = [connection for found, connection in self._connections.get(topic, ()) if found == number]
            if wanted:
                for connection, time_ns, data in self._one_by_one(part.messages(wanted)):
                    yield number, connection, time_ns, data

    def _one_by_one(self, messages: Iterator[Message]) -> Iterator[Message]:
        """Yield the messages, each of which is read while no other thread reads."""
        while True:
            with self._reading:
                message = next(messages, None)
            if message is None:
                return
            yield message

    def _deserialise(self, connection: Connection, data: bytes) -> Any:
        if data.startswith(_ZSTD):
            raise DatasetError(
                f"{self._path}: {connection.topic}: the recorder compressed each message; expected the folder with its "
                "metadata.yaml, which says so"
            )
        store, message_type = self._store_of(connection), _type_of(connection)
        if _is_ros1(connection):
            return store.deserialize_ros1(data, message_type)
        return store.deserialize_cdr(data, message_type)

    def _store_of(self, connection: Connection) -> Typestore:
        """Return the definition of a topic's message type in the bag, else the standard one."""
        with self._reading:
            if connection.topic not in self._stores:
                self._stores[connection.topic] = _typestore(connection)
        return self._stores[connection.topic]

    @contextmanager
    def _readable(self, topic: str = "") -> Iterator[None]:
        """Raise DatasetError for any error of the reader: damaged files cause errors of many types in it."""
        try:
            yield
        except GeneratorExit:
            raise
        except DatasetError as error:
            if not topic and (foreign := foreign_part(self._path)):
                raise DatasetError(f"{self._path}: expected a readable bag, got {foreign}") from None
            raise error
        except Exception as error:
            location = f"{self._path}: {topic}" if topic else str(self._path)
            if not topic and (foreign := foreign_part(self._path)):
                raise DatasetError(f"{location}: expected a readable bag, got {foreign}") from None
            reason = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
            advice = "" if topic else f"; {repair_of(self._path)}"
            raise DatasetError(f"{location}: expected a readable bag; {reason}{advice}") from None


def _typestore(connection: Connection) -> Typestore:
    from rosbags.interfaces import MessageDefinitionFormat

    is_message = connection.msgdef.format is MessageDefinitionFormat.MSG
    definition = connection.msgdef.data if is_message else ""
    return _typestore_of(definition, _type_of(connection), _is_ros1(connection))


@lru_cache(maxsize=64)
def _typestore_of(definition: str, message_type: str, is_ros1: bool) -> Typestore:
    """Return the types of a definition, which rosbags parses and compiles; the standard ones for ""."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if definition:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, message_type))
        return store
    if not is_ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF_MESSAGE))
    return store


def _type_of(connection: Connection) -> str:
    """Return the type's name as ROS 2 writes it."""
    name = connection.msgtype
    if "/msg/" not in name:
        name = name.replace("/", "/msg/", 1)
    return _ALIASES.get(name, name)


def _serialisation(connection: Connection) -> str:
    """Return the name of the messages' serialisation; MCAP files may have several."""
    return str(getattr(connection.ext, "serialization_format", "ros1"))


def _is_ros1(connection: Connection) -> bool:
    return _serialisation(connection) == "ros1"


def _header_stamp_ns(data: bytes, is_ros1: bool) -> int:
    """Return the stamp of the header with which a serialised message begins."""
    if is_ros1:
        seconds, nanoseconds = _STAMP_ROS1.unpack_from(data)
    else:
        # the second byte states the byte order
        seconds, nanoseconds = _STAMP_ROS2[data[1] & 1].unpack_from(data)
    return int(seconds) * 10**9 + int(nanoseconds)
