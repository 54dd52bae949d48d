"""Named arrays in one checked file: how a mapping run lies on disk between two processes, bit for bit.

Little-endian. A head (magic, version, number of arrays, size of the whole file), a table of contents (name, type and
shape of each array), the arrays one after the other, and a CRC-32 of all that. Sizes are compared with the file's own
before anything is read. Nothing in it is ever executed.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.codec.files import write_atomic_parts
from gausslite.domain.state import State
from gausslite.errors import MapFileError

MAGIC = b"GLSTATE\n"
VERSION = 1
_HEAD = struct.Struct("<8sIIQ")
_ENTRY = struct.Struct("<HBB")
_CRC = struct.Struct("<I")
_TYPES = ("|b1", "|u1", "<i2", "<u4", "<i8", "<u8", "<f4", "<f8")
_MAX_DIMENSIONS = 8


def write_state(path: Path, state: State) -> None:
    """Write the file whole or not at all. Raises StorageError."""
    arrays = {name: np.asarray(array, order="C") for name, array in state.items()}
    contents = b"".join(_entry(name, array) for name, array in arrays.items())
    size = _HEAD.size + len(contents) + sum(array.nbytes for array in arrays.values()) + _CRC.size
    head = _HEAD.pack(MAGIC, VERSION, len(arrays), size)
    data = (array.reshape(-1).view(np.uint8).data for array in arrays.values())
    write_atomic_parts(path, _with_crc([head, contents, *data]))


def read_state(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays, read-only. Raises MapFileError when the file is damaged, of another kind or cannot be read."""
    try:
        data = _read(path)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, len(data) - _CRC.size)[0]:
        raise MapFileError(f"{path}: expected an undamaged saved run, got other bytes than its checksum says")
    try:
        return _arrays(memoryview(data)[: -_CRC.size])
    except (struct.error, ValueError) as error:
        raise MapFileError(f"{path}: expected an undamaged saved run: {error}") from None


def _read(path: Path) -> bytes:
    """The bytes of a file whose head and length agree."""
    if not path.is_file():
        raise MapFileError(f"{path}: expected the file of a saved run, got none")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or not head.startswith(MAGIC):
            raise MapFileError(f"{path}: expected the file of a saved run, got another kind of file")
        _, version, _, declared = _HEAD.unpack(head)
        if version != VERSION:
            raise MapFileError(f"{path}: expected a saved run of version {VERSION}, got version {version}")
        if declared != size or size < _HEAD.size + _CRC.size:
            raise MapFileError(f"{path}: expected {declared} bytes, got {size}: the file is not whole")
        rest = file.read(size - _HEAD.size)
    if len(rest) != size - _HEAD.size:
        raise MapFileError(f"{path}: it changed while it was read")
    return head + rest


def _arrays(data: memoryview) -> dict[str, NDArray[Any]]:
    """Split checked bytes. Raises struct.error, ValueError for a table of contents that does not fit them."""
    count = _HEAD.unpack_from(data)[2]
    at = _HEAD.size
    entries: list[tuple[str, np.dtype[Any], tuple[int, ...]]] = []
    for _ in range(count):
        length, kind, dimensions = _ENTRY.unpack_from(data, at)
        at += _ENTRY.size
        if kind >= len(_TYPES) or dimensions > _MAX_DIMENSIONS:
            raise ValueError(f"array {len(entries)} has an unknown type or too many dimensions")
        name = bytes(data[at : at + length]).decode()
        shape = struct.unpack_from(f"<{dimensions}Q", data, at + length)
        at += length + 8 * dimensions
        entries.append((name, np.dtype(_TYPES[kind]), shape))
    arrays: dict[str, NDArray[Any]] = {}
    for name, dtype, shape in entries:
        size = math.prod(shape) * dtype.itemsize
        if size > len(data) - at:
            raise ValueError(f"array {name} would take {size} bytes, {len(data) - at} are left")
        if dtype.kind == "b" and max(data[at : at + size], default=0) > 1:
            raise ValueError(f"array {name} has other values than true and false")
        arrays[name] = np.frombuffer(data[at : at + size], dtype).reshape(shape)
        at += size
    if at != len(data) or len(arrays) != count:
        raise ValueError("its table of contents does not fit its bytes")
    return arrays


def _entry(name: str, array: NDArray[Any]) -> bytes:
    encoded = name.encode()
    kind = _TYPES.index(array.dtype.newbyteorder("<").str)
    return _ENTRY.pack(len(encoded), kind, array.ndim) + encoded + struct.pack(f"<{array.ndim}Q", *array.shape)


def _with_crc(parts: Iterable[bytes | memoryview]) -> Iterator[bytes | memoryview]:
    crc = 0
    for each in parts:
        crc = zlib.crc32(each, crc)
        yield each
    yield _CRC.pack(crc)
