"""Keep pages of bytes in the blocks of one temporary file of bounded size, each page with its checksum."""

from __future__ import annotations

import mmap
import os
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from weakref import finalize

import numpy as np
from jaxtyping import Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.state import State, get_array, int_array

BLOCK_BYTES = 1 << 14
"""Half of a block is lost per page: 8 kB of the 300 kB of a tile with a thousand Gaussians."""


@dataclass(frozen=True, slots=True)
class Page:
    """Where some bytes are, and how many."""

    blocks: tuple[int, ...]
    size: int
    crc: int


class PageFile:
    """Owns the file, which has no name and ends with the process. Not thread-safe."""

    def __init__(self) -> None:
        """The folder of temporary files is that of TMPDIR."""
        self._fd, path = tempfile.mkstemp(prefix="gausslite-")
        Path(path).unlink()
        finalize(self, os.close, self._fd)
        self._free: list[int] = []
        self._end = 0

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._end * BLOCK_BYTES

    def write(self, data: bytes, max_size: int) -> Page | None:
        """Store the bytes; None if the file would be larger than max_size, or the disk is full."""
        count = -(-len(data) // BLOCK_BYTES)
        reused = self._free[::-1][:count]
        blocks = (*reused, *range(self._end, self._end + count - len(reused)))
        if (max(blocks, default=0) + 1) * BLOCK_BYTES > max_size:
            return None
        try:
            for i, block in enumerate(blocks):
                part = data[i * BLOCK_BYTES : (i + 1) * BLOCK_BYTES]
                if os.pwrite(self._fd, part, block * BLOCK_BYTES) < len(part):
                    return None
        except OSError:
            return None
        del self._free[len(self._free) - len(reused) :]
        self._end += count - len(reused)
        return Page(blocks, len(data), zlib.crc32(data))

    def read(self, page: Page) -> bytes:
        """Return a page's bytes. Raises MapFileError if they are damaged."""
        try:
            parts = [os.pread(self._fd, BLOCK_BYTES, block * BLOCK_BYTES) for block in page.blocks]
        except OSError as error:
            raise MapFileError(f"disk-mb: the file of the map's parts cannot be read: {error.strerror}") from error
        data = b"".join(parts)[: page.size]
        if zlib.crc32(data) != page.crc:
            raise MapFileError("disk-mb: expected the map's parts as they were stored, got a damaged one")
        return data

    def release(self, page: Page) -> None:
        """Give the blocks of a page back."""
        self._free.extend(reversed(page.blocks))

    def state(self) -> State:
        """Return the content of the file, mapped and not read, and its free blocks."""
        data: UInt8[ndarray, " b"] = np.zeros(0, np.uint8)
        if self._end:
            os.ftruncate(self._fd, self.size)
            data = np.frombuffer(mmap.mmap(self._fd, self.size, access=mmap.ACCESS_READ), np.uint8)
        return {"data": data, "free": int_array(*self._free)}

    def restore(self, state: State, max_size: int) -> None:
        """Replace the content by that of another file. Raises MapFileError."""
        data: UInt8[ndarray, " b"] = get_array(state, "data", (None,), np.uint8)
        free: Int64[ndarray, " f"] = get_array(state, "free", (None,), np.int64)
        end = len(data) // BLOCK_BYTES
        if len(data) > max_size or len(data) % BLOCK_BYTES or not ((free >= 0) & (free < end)).all():
            raise MapFileError(f"state pages: expected at most {max_size} bytes in whole blocks, got {len(data)}")
        try:
            for start in range(0, len(data), BLOCK_BYTES):
                os.pwrite(self._fd, data[start : start + BLOCK_BYTES].data, start)
        except OSError as error:
            raise MapFileError(f"disk-mb: the map's parts cannot be stored: {error.strerror}") from error
        self._free, self._end = free.tolist(), end
