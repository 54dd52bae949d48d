"""Read a bag (ROS 1 files, ROS 2 folders, single MCAP or SQLite files) by its address with options."""

from __future__ import annotations

import re
import struct
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from gausslite.domain.errors import DatasetError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


PREFIX = "bag:"
_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_TOLERANCE = re.compile(r"([0-9]{1,4}(?:\.[0-9]{1,3})?)ms")
_AXES = ("optical", "body")


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Topics and frames of a bag, as written in its address; an empty text leaves the choice to the reader.

    color, depth: image topics. color_info, depth_info: their camera_info topics. odom: a topic with poses, used instead
    of tf. body: the frame whose pose that topic states. frame: the world frame in tf. camera: the colour camera's
    frame. axes: "optical" (z forward) or "body" (x forward), the convention of the camera frames. tolerance_s: largest
    difference of the stamps of a colour and a depth image.
    """

    color: str = ""
    depth: str = ""
    color_info: str = ""
    depth_info: str = ""
    odom: str = ""
    body: str = ""
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
    def parse(cls, spec: str) -> BagAddress | None:
        """Return the address of "bag:PATH?color=TOPIC&...", or of a path that is a bag; None for other sources.

        Raises DatasetError for unknown options, and if there is no bag behind the prefix.
        """
        text = spec.removeprefix(PREFIX)
        name, _, query = text.partition("?")
        if Path(text).expanduser().exists():
            # a name may have a question mark
            name, query = text, ""
        path = Path(name).expanduser()
        if not _is_bag(path):
            if spec.startswith(PREFIX):
                raise DatasetError(f"{spec}: {_reason(path)}")
            return None
        return cls(path, _parse_options(spec, query))


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / _METADATA).is_file()
    return path.is_file() and path.suffix in _SUFFIXES


def _reason(path: Path) -> str:
    expected = f"expected a bag: a file {', '.join('*' + suffix for suffix in _SUFFIXES)}, or a folder with {_METADATA}"
    if path.is_dir():
        return f"{expected}; got a folder without it"
    return f"{expected}; got {'a file ' + path.name if path.exists() else 'nothing there'}"


def _parse_options(spec: str, query: str) -> BagOptions:
    names = [field.name for field in fields(BagOptions) if field.name not in ("tolerance_s", "axes")]
    chosen: dict[str, Any] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if (key in names and value) or (key == "axes" and value in _AXES):
            chosen[key] = value
        elif key == "tolerance" and (match := _TOLERANCE.fullmatch(value)):
            chosen["tolerance_s"] = float(match.group(1)) / 1000
        else:
            expected = "&".join([*(f"{name}=..." for name in names), f"axes={'|'.join(_AXES)}", "tolerance=Xms"])
            raise DatasetError(f"{spec}: {key}={value}: expected {expected}, each optional")
    return BagOptions(**chosen)


_TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_ALIASES = {"tf/msg/tfMessage": _TF_MESSAGE}
_STAMP_ROS1, _STAMP_ROS2 = struct.Struct("<4xII"), (struct.Struct(">4xiI"), struct.Struct("<4xiI"))


@dataclass(frozen=True, slots=True)
class MessageKey:
    """Where a message is in a bag: its topic, the time when it was recorded, and its rank among equal times."""

    topic: str
    recorded_ns: int
    rank: int


@dataclass(frozen=True, slots=True)
class StampedMessage:
    """A message by its position in the bag and the stamp of its header."""

    key: MessageKey
    stamp_ns: int


class BagFile:
    """An opened bag with random access to its messages.

    Only the types of topics that are read are defined, so that a damaged definition of another type does no harm.
    Raises DatasetError for a bag that cannot be read, and without the extra `ros`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stores: dict[str, Typestore] = {}
        reader_class = _reader_class(path)
        with self._readable():
            reader = reader_class(path)
            reader.open()
            weakref.finalize(self, reader.close)
            self._reader = reader
            self._connections: dict[str, list[Connection]] = {}
            for connection in reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)

    @property
    def path(self) -> Path:
        """File or folder of the bag."""
        return self._path

    @property
    def types(self) -> dict[str, str]:
        """Message type of each topic, such as sensor_msgs/msg/Image, sorted by topic; topics without messages too."""
        return {topic: _type_of(found[0]) for topic, found in sorted(self._connections.items())}

    def first(self, topic: str) -> Any | None:
        """Return the first message of a topic; None if it has none. Raises DatasetError."""
        return next(self.messages(topic), None)

    def messages(self, topic: str) -> Iterator[Any]:
        """Yield all messages of a topic in the order of recording. Raises DatasetError."""
        if topic not in self._connections:
            return
        with self._readable(topic):
            for connection, _, data in self._reader.messages(connections=self._connections[topic]):
                yield self._deserialise(connection, data)

    def stamps(self, topic: str) -> list[StampedMessage]:
        """Return all messages of a topic by the stamps of their headers, ascending. Raises DatasetError.

        A header without a stamp counts from the time when the message was recorded. Payloads are not decoded.
        """
        found: list[StampedMessage] = []
        last_ns, rank = -1, 0
        with self._readable(topic):
            for connection, time_ns, data in self._reader.messages(connections=self._connections[topic]):
                rank = rank + 1 if time_ns == last_ns else 0
                last_ns = time_ns
                stamp_ns = _header_stamp_ns(data, _is_ros1(connection)) or time_ns
                found.append(StampedMessage(MessageKey(topic, time_ns, rank), stamp_ns))
        return sorted(found, key=lambda message: message.stamp_ns)

    def read(self, key: MessageKey) -> Any:
        """Return one message. Raises DatasetError."""
        start_ns = key.recorded_ns
        with self._readable(key.topic):
            at_time = self._reader.messages(connections=self._connections[key.topic], start=start_ns, stop=start_ns + 1)
            for rank, (connection, _, data) in enumerate(at_time):
                if rank == key.rank:
                    return self._deserialise(connection, data)
        raise DatasetError(f"{self._path}: {key.topic}: expected a message at {start_ns} ns, got none")

    def _deserialise(self, connection: Connection, data: bytes) -> Any:
        store, message_type = self._store_of(connection), _type_of(connection)
        if _is_ros1(connection):
            return store.deserialize_ros1(data, message_type)
        return store.deserialize_cdr(data, message_type)

    def _store_of(self, connection: Connection) -> Typestore:
        """Return the definition of a topic's message type in the bag, else the standard one."""
        if connection.topic not in self._stores:
            self._stores[connection.topic] = _typestore(connection)
        return self._stores[connection.topic]

    @contextmanager
    def _readable(self, topic: str = "") -> Iterator[None]:
        """Raise DatasetError for any error of the reader: damaged files cause errors of many types in it."""
        try:
            yield
        except (DatasetError, GeneratorExit):
            raise
        except Exception as error:
            location = f"{self._path}: {topic}" if topic else str(self._path)
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise DatasetError(f"{location}: expected a readable bag; {reason}") from None


def _reader_class(path: Path) -> Callable[[Path], Any]:
    """Return the reader for a bag. Raises DatasetError without the extra `ros`."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise DatasetError(
            f"{path}: a bag needs the extra `ros`; install it with: pip install 'gausslite[ros]'"
        ) from None
    return Reader1 if path.suffix == ".bag" and path.is_file() else Reader2


def _typestore(connection: Connection) -> Typestore:
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if connection.msgdef.format is MessageDefinitionFormat.MSG and connection.msgdef.data:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(connection.msgdef.data, _type_of(connection)))
        return store
    if not _is_ros1(connection):
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


def _is_ros1(connection: Connection) -> bool:
    """True for messages in the serialisation of ROS 1, which MCAP files may have too."""
    serialisation = getattr(connection.ext, "serialization_format", "ros1")
    if serialisation not in ("ros1", "cdr"):
        raise DatasetError(f"{connection.topic}: expected messages as ros1 or cdr, got {serialisation!r}")
    return bool(serialisation == "ros1")


def _header_stamp_ns(data: bytes, is_ros1: bool) -> int:
    """Return the stamp of the header with which a serialised message begins."""
    if is_ros1:
        seconds, nanoseconds = _STAMP_ROS1.unpack_from(data)
    else:
        # the second byte states the byte order
        seconds, nanoseconds = _STAMP_ROS2[data[1] & 1].unpack_from(data)
    return int(seconds) * 10**9 + int(nanoseconds)
