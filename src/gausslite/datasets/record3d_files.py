"""Read the files of a Record3D recording, from the .r3d file (a ZIP) or its unzipped folder, without trusting sizes."""

from __future__ import annotations

import re
import weakref
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.errors import DatasetError

METADATA = "metadata"
_COLOUR_NAME = re.compile(r"rgbd/(\d{1,7})\.jpg")
_MAX_FILE_BYTES = 1 << 28
_UNCOMPRESSED, _LZVN, _LZFSE, _END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"


class Record3dFiles:
    """The files by their names in the recording, such as "rgbd/0.jpg". Raises DatasetError."""

    def __init__(self, path: Path) -> None:
        self._path, self._zip = path, None
        if path.is_dir():
            return
        try:
            self._zip = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, OSError) as error:
            raise DatasetError(f"{path}: expected an .r3d file, which is a ZIP; {error}") from None
        weakref.finalize(self, self._zip.close)

    def path_of(self, name: str) -> str:
        """Return the file's name for messages."""
        return str(self._path / name)

    def colour_numbers(self) -> list[int]:
        """Return the numbers of the colour images, ascending."""
        if self._zip is None:
            names = [f"rgbd/{path.name}" for path in (self._path / "rgbd").glob("*.jpg")]
        else:
            names = self._zip.namelist()
        return sorted(int(match.group(1)) for match in map(_COLOUR_NAME.fullmatch, names) if match)

    def has(self, name: str) -> bool:
        """True if the recording has this file."""
        return (self._path / name).is_file() if self._zip is None else name in self._zip.NameToInfo

    def read(self, name: str) -> bytes:
        """Return a file's bytes. Raises DatasetError if it is missing, damaged or too large."""
        if not self.has(name):
            raise DatasetError(f"{self.path_of(name)}: expected this file of a Record3D recording, got none")
        try:
            file = self._path / name
            size_bytes = file.stat().st_size if self._zip is None else self._zip.getinfo(name).file_size
            if size_bytes > _MAX_FILE_BYTES:
                raise DatasetError(f"{file}: expected at most {_MAX_FILE_BYTES} bytes, got {size_bytes}")
            return file.read_bytes() if self._zip is None else self._zip.read(name)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, NotImplementedError) as error:
            raise DatasetError(f"{self.path_of(name)}: expected a readable file; {error}") from None

    def read_array(self, name: str, dtype: type[np.generic], count: int) -> NDArray[Any]:
        """Return the `count` little-endian values of an LZFSE file.

        The size that the file declares is checked before it is decompressed. Raises DatasetError, also without the
        extra `record3d`.
        """
        data, location = self.read(name), self.path_of(name)
        expected_bytes = count * np.dtype(dtype).itemsize
        declared_bytes = _declared_bytes(data)
        if declared_bytes != expected_bytes:
            got = "bytes of another format" if declared_bytes is None else f"{declared_bytes} bytes"
            raise DatasetError(f"{location}: expected {expected_bytes} bytes, compressed with LZFSE, got {got}")
        lzfse = _lzfse(location)
        try:
            values = lzfse.decompress(data)
        except lzfse.error as error:
            raise DatasetError(f"{location}: expected undamaged LZFSE data; {error}") from None
        if len(values) != expected_bytes:
            raise DatasetError(f"{location}: expected {expected_bytes} bytes, compressed with LZFSE, got {len(values)}")
        return np.frombuffer(values, np.dtype(dtype).newbyteorder("<")).astype(dtype)


def _lzfse(location: str) -> Any:
    try:
        import lzfse
    except ImportError:
        raise DatasetError(
            f"{location}: a Record3D recording needs the extra `record3d`; install it with: pip install "
            "'gausslite[record3d]'"
        ) from None
    return lzfse


def _declared_bytes(data: bytes) -> int | None:
    """Return the sum of the blocks' uncompressed sizes; None for bytes that are no sequence of LZFSE blocks.

    Source: lzfse_internal.h of the reference implementation. A block is a magic number, its uncompressed size, fields
    by its type, and its payload.
    """
    total_bytes = offset = 0
    while (magic := data[offset : offset + 4]) != _END:
        raw_bytes = _unsigned(data, offset + 4, 4)
        if magic == _UNCOMPRESSED:
            block_bytes = 8 + raw_bytes
        elif magic == _LZVN:
            block_bytes = 12 + _unsigned(data, offset + 8, 4)
        elif magic == _LZFSE:
            first, second, third = (_unsigned(data, offset + at, 8) for at in (8, 16, 24))
            block_bytes = (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
        else:
            return None
        if block_bytes < 8:
            return None
        total_bytes, offset = total_bytes + raw_bytes, offset + block_bytes
    return total_bytes


def _unsigned(data: bytes, offset: int, size_bytes: int) -> int:
    return int.from_bytes(data[offset : offset + size_bytes], "little")
