"""Compress arrays into one zstd frame, with a block of its own for each, so that each gets its own entropy tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from gausslite.domain.errors import CodecError

_ZSTD_LEVEL = 3
_MIN_WINDOW_BYTES = 1 << 10


@dataclass(frozen=True, slots=True)
class Column:
    """Type, such as <u4, and shape of an array in a frame."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def byte_count(self) -> int:
        """Bytes before compression."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


def compress_columns(arrays: Sequence[NDArray[Any]], columns: Sequence[Column]) -> bytes:
    """Return the frame. The bytes of a column are shuffled: all first bytes, then all second bytes, and so on."""
    packed = [
        _shuffle(np.ascontiguousarray(array, column.dtype)) for array, column in zip(arrays, columns, strict=True)
    ]
    compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compressobj(size=sum(len(each) for each in packed))
    parts = []
    for each in packed:
        parts += [compressor.compress(each), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*parts, compressor.flush()])


def decompress_columns(frame: bytes, columns: Sequence[Column]) -> list[NDArray[Any]]:
    """Return the arrays. Raises CodecError, before memory is allocated, if the frame declares another size."""
    sizes = [column.byte_count for column in columns]
    size = sum(sizes)
    try:
        header = zstandard.get_frame_parameters(frame)
        if header.content_size != size or header.window_size > max(size, _MIN_WINDOW_BYTES):
            raise CodecError(f"subset: expected a body of {size} bytes, got {header.content_size}")
        raw = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(f"subset: body is not one zstd frame: {error}") from error
    arrays, start = [], 0
    for column, byte_count in zip(columns, sizes, strict=True):
        arrays.append(_unshuffle(raw[start : start + byte_count], column))
        start += byte_count
    return arrays


def _shuffle(array: NDArray[Any]) -> bytes:
    return array.view(np.uint8).reshape(-1, array.itemsize).T.tobytes()


def _unshuffle(raw: bytes, column: Column) -> NDArray[Any]:
    planes = np.frombuffer(raw, np.uint8).reshape(np.dtype(column.dtype).itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).view(column.dtype).reshape(column.shape)
