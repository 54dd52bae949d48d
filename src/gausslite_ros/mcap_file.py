"""Read MCAP files of ROS 1 and ROS 2: of any profile, without indexes, and up to the place where they were cut.

The records are those of the MCAP specification, version 0: an operation code, a length, and fields in little-endian.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import zstandard

from gausslite.domain.errors import DatasetError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _DATA_END = 2, 3, 4, 5, 6, 8, 15
_RECORD, _MESSAGE_START, _CHUNK_START = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")
_CHUNK_PLACE = struct.Struct("<QQQQ")
_FOOTER_BYTES = _RECORD.size + 20 + len(_MAGIC)
_MAX_CHUNK_BYTES = 1 << 31

Message = tuple["Connection", int, bytes]
"""Channel, time of recording in nanoseconds, and serialised message."""


class _Fields:
    """Reads the fields of a record one after the other."""

    def __init__(self, content: bytes) -> None:
        self._content, self._position = content, 0

    def numbers(self, layout: struct.Struct) -> tuple[int, ...]:
        found: tuple[int, ...] = layout.unpack_from(self._content, self._position)
        self._position += layout.size
        return found

    def number(self, layout: str) -> int:
        return self.numbers(struct.Struct(f"<{layout}"))[0]

    def block(self) -> bytes:
        size = self.number("I")
        self._position += size
        return self._content[self._position - size : self._position]

    def text(self) -> str:
        return self.block().decode()

    def rest(self) -> bytes:
        return self._content[self._position :]


@dataclass(frozen=True, slots=True)
class _Place:
    """A chunk, or a message outside chunks: the range of its times, and the record's content in the file.

    channels: those of its messages; None if the file does not state them.
    """

    start_ns: int
    end_ns: int
    offset: int
    size: int
    code: int
    channels: frozenset[int] | None


class McapFile:
    """An opened MCAP file, with the interface of a reader of rosbags.

    A file with an index of its chunks is read by it, another one is scanned once. Raises DatasetError.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, Connection] = {}
        self._places: list[_Place] = []
        self._lacks_schemas = False
        self._cut_at: int | None = None
        self._last_chunk: tuple[int, bytes] = (-1, b"")
        self._size = path.stat().st_size
        self._file = path.open("rb")
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    @property
    def connections(self) -> list[Connection]:
        """The channels of messages."""
        return list(self._channels.values())

    @property
    def note(self) -> str:
        """Message on a file that was cut short; empty for a whole one."""
        if self._cut_at is None:
            return ""
        return f"{self._path.name} was cut short after {self._cut_at} bytes; the messages before that are used"

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of these channels from start until before stop in the order of their times."""
        wanted = {connection.id for connection in connections}
        low, high = -1 if start is None else start, 1 << 64 if stop is None else stop
        waiting: list[tuple[int, int, int, bytes]] = []
        order = 0
        for place in sorted(self._places, key=lambda place: place.start_ns):
            if place.end_ns < low or place.start_ns >= high or not wanted & (place.channels or wanted):
                continue
            while waiting and waiting[0][0] < place.start_ns:
                yield self._message(heapq.heappop(waiting))
            for channel, time_ns, data in self._messages_at(place):
                if channel in wanted and low <= time_ns < high:
                    heapq.heappush(waiting, (time_ns, order, channel, data))
                    order += 1
        while waiting:
            yield self._message(heapq.heappop(waiting))

    def _message(self, found: tuple[int, int, int, bytes]) -> Message:
        return self._channels[found[2]], found[0], found[3]

    def _open(self) -> None:
        path = self._path
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise DatasetError(f"{path}: expected an MCAP file, got {'other bytes' if self._size else 'an empty file'}")
        if not self._read_summary():
            self._schemas, self._channels, self._places = {}, {}, []
            self._scan()
        if self._cut_at is not None and not self._channels:
            raise DatasetError(f"{path}: expected messages, got a file that was cut short after {self._cut_at} bytes")

    def _read_summary(self) -> bool:
        """Read channels, their schemas and chunks from the end of the file; False if they are not all there."""
        self._file.seek(max(self._size - _FOOTER_BYTES, 0))
        footer = self._file.read()
        if not footer.endswith(_MAGIC) or footer[0] != _FOOTER:
            return False
        start = struct.unpack_from("<Q", footer, _RECORD.size)[0]
        if not 0 < start < self._size - _FOOTER_BYTES:
            return False
        for code, offset, size in self._records(start, self._size - _FOOTER_BYTES):
            if code in (_SCHEMA, _CHANNEL):
                self._define(code, self._read(offset, size))
            elif code == _CHUNK_INDEX:
                fields = _Fields(self._read(offset, size))
                start_ns, end_ns, chunk_at, length = fields.numbers(_CHUNK_PLACE)
                indexes = fields.block()
                channels = frozenset(channel for channel, _ in struct.iter_unpack("<HQ", indexes)) if indexes else None
                record_at = chunk_at + _RECORD.size
                self._places.append(_Place(start_ns, end_ns, record_at, length - _RECORD.size, _CHUNK, channels))
        return bool(self._places) and bool(self._channels) and not self._lacks_schemas

    def _scan(self) -> None:
        """Read channels and the places of messages from all records, until one is not whole."""
        for code, offset, size in self._records(len(_MAGIC), self._size):
            if code in (_DATA_END, _FOOTER):
                return
            if code in (_SCHEMA, _CHANNEL):
                self._define(code, self._read(offset, size))
            elif code == _MESSAGE:
                channel, _, time_ns, _ = _MESSAGE_START.unpack(self._read(offset, _MESSAGE_START.size))
                self._places.append(_Place(time_ns, time_ns, offset, size, code, frozenset((channel,))))
            elif code == _CHUNK and offset + _CHUNK_START.size <= self._size:
                start_ns, end_ns, _, _ = _CHUNK_START.unpack(self._read(offset, _CHUNK_START.size))
                place = _Place(start_ns, end_ns, offset, size, code, None)
                for inner, content in _records_in(self._chunk(place)):
                    if inner in (_SCHEMA, _CHANNEL):
                        self._define(inner, content)
                self._places.append(place)

    def _records(self, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """Yield operation code, offset and size of the records; a chunk that is not whole comes last."""
        position = start
        while position + _RECORD.size <= stop:
            code, size = _RECORD.unpack(self._read(position, _RECORD.size))
            position += _RECORD.size
            if position + size > stop or code == 0:
                self._cut_at = min(position, stop) if code == 0 else stop
                if code == _CHUNK:
                    yield code, position, stop - position
                return
            yield code, position, size
            position += size
        if stop == self._size:
            # a whole file ends with its data, a footer and the magic
            self._cut_at = stop

    def _define(self, code: int, content: bytes) -> None:
        """Add a schema or a channel."""
        from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

        fields = _Fields(content)
        number = fields.number("H")
        if code == _SCHEMA:
            self._schemas[number] = fields.text(), fields.text(), fields.text()
            return
        schema = fields.number("H")
        # 0: a channel without a schema
        self._lacks_schemas |= schema != 0 and schema not in self._schemas
        name, encoding, text = self._schemas.get(schema, ("unknown", "", ""))
        is_msg = encoding in ("ros1msg", "ros2msg")
        definition = MessageDefinition(
            MessageDefinitionFormat.MSG if is_msg else MessageDefinitionFormat.NONE, text if is_msg else ""
        )
        topic, serialisation = fields.text(), fields.text()
        extension = ConnectionExtRosbag2(serialisation, [])
        self._channels[number] = Connection(
            id=number, topic=topic, msgtype=name, msgdef=definition, digest="", msgcount=0, ext=extension, owner=self
        )

    def _messages_at(self, place: _Place) -> Iterator[tuple[int, int, bytes]]:
        """Yield channel, time and data of the messages at a place."""
        if place.code == _MESSAGE:
            found = [(_MESSAGE, self._read(place.offset, place.size))]
        else:
            found = [record for record in _records_in(self._chunk(place)) if record[0] == _MESSAGE]
        for _, content in found:
            channel, _, time_ns, _ = _MESSAGE_START.unpack_from(content)
            if channel in self._channels:
                yield channel, time_ns, content[_MESSAGE_START.size :]

    def _chunk(self, place: _Place) -> bytes:
        """Return the records of a chunk; of one that was cut short, those that are whole, unless it is compressed."""
        if self._last_chunk[0] != place.offset:
            content = self._read(place.offset, place.size)
            fields = _Fields(content)
            _, _, size, checksum = fields.numbers(_CHUNK_START)
            compression, stored = fields.text(), fields.number("Q")
            data = fields.rest()
            if len(data) < stored:
                records = b"" if compression else data
            else:
                records = _decompressed(self._path, compression, data[:stored], size)
                if checksum and zlib.crc32(records) != checksum:
                    raise DatasetError(f"{self._path}: expected an undamaged chunk, got one whose checksum is wrong")
            self._last_chunk = place.offset, records
        return self._last_chunk[1]

    def _read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)


def _records_in(chunk: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield operation code and content of the whole records."""
    position = 0
    while position + _RECORD.size <= len(chunk):
        code, size = _RECORD.unpack_from(chunk, position)
        position += _RECORD.size
        if position + size > len(chunk):
            return
        yield code, chunk[position : position + size]
        position += size


def _decompressed(path: Path, compression: str, data: bytes, size: int) -> bytes:
    if size > _MAX_CHUNK_BYTES:
        raise DatasetError(f"{path}: expected chunks of at most {_MAX_CHUNK_BYTES} bytes, got {size}")
    if compression == "":
        return data
    if compression == "zstd":
        records = bytes(zstandard.ZstdDecompressor().stream_reader(data).read(size))
    elif compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        records = bytes(LZ4FrameDecompressor().decompress(data, max_length=size))
    else:
        raise DatasetError(f"{path}: expected chunks compressed with zstd or lz4, got {compression!r}")
    if len(records) != size:
        raise DatasetError(f"{path}: expected a chunk of {size} bytes, got {len(records)}")
    return records
