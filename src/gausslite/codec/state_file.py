"""Write files atomically: named arrays in one checked file, a mapping run bit for bit, and PNG images.

The file is a safetensors file. Its metadata holds the format's name, its version and a CRC-32 over the names, types,
shapes and bytes of all arrays. safetensors compares all sizes with the file's before it allocates memory, and the
format cannot contain code.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from gausslite.domain.errors import MapFileError, StorageError
from gausslite.domain.state import State

FORMAT = "gausslite-state"
VERSION = "2"
_TYPES = {"BOOL", "U8", "I16", "I32", "U32", "I64", "U64", "F32", "F64"}
_LENGTH_BYTES, _MAX_HEADER_BYTES = 8, 1 << 24
"""A safetensors file begins with the length of its JSON header, which is checked before anything is allocated."""


def write_atomic(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Write the bytes, or one block after the other, to a temporary file in the same folder; rename it to `path`.

    A device or pipe is written to directly. Raises StorageError if the folder is not writable or the disk is full.
    """

    def write(to: Path) -> None:
        with to.open("wb") as file:
            file.writelines((data,) if isinstance(data, bytes) else data)

    try:
        if path.exists() and not path.is_file():
            write(path)
            return
    except OSError as error:
        raise _cannot_write(path, error) from error
    write_atomic_with(path, write)


def write_atomic_with(path: Path, write: Callable[[Path], object], mode: int = 0o644) -> None:
    """Let `write` fill a temporary file in the same folder, then rename it to `path`.

    The next write of this path replaces what a killed one left. Raises StorageError if `path` is not a regular file,
    the folder is not writable or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.partial")
    try:
        if path.exists() and not path.is_file():
            raise StorageError(f"{path}: expected a regular file or none, got something else")
        with _locked(temporary):
            try:
                write(temporary)
                with temporary.open("rb") as file:
                    os.fsync(file.fileno())
                temporary.chmod(mode)
                temporary.replace(path)
            except BaseException:
                with contextlib.suppress(OSError):
                    temporary.unlink()
                raise
    except OSError as error:
        raise _cannot_write(path, error) from error


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Make a file that one writer at a time has under this name, or take over that of a killed one."""
    while True:
        with path.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            try:
                is_own = os.path.samestat(path.stat(), os.fstat(file.fileno()))
            except FileNotFoundError:
                # the writer before has renamed it
                is_own = False
            if is_own:
                path.chmod(0o600)
                file.truncate(0)
                yield
                return


def _cannot_write(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{path}: cannot be written: {error.strerror or error}")


def write_png(path: Path, image: UInt8[ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG. Raises StorageError naming the file."""
    import cv2

    encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_atomic(path, encoded.tobytes())


def write_state(path: Path, state: State, mode: int = 0o644) -> None:
    """Write the arrays atomically. Raises StorageError."""
    arrays = {name: np.asarray(array, order="C") for name, array in state.items()}
    metadata = {"format": FORMAT, "version": VERSION, "crc32": _checksum(arrays)}
    try:
        write_atomic_with(path, lambda temporary: save_file(arrays, temporary, metadata), mode)
    except SafetensorError as error:
        raise StorageError(f"{path}: cannot be written: {error}") from error


def read_state(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays, read-only. Raises MapFileError if the file is damaged, unreadable or of another kind."""
    try:
        _require_header(path)
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            _require_version(path, metadata)
            types = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118 - not a dict
            if unknown := set(types.values()) - _TYPES:
                raise MapFileError(f"{path}: expected arrays of {', '.join(sorted(_TYPES))}, got {unknown.pop()}")
            arrays: dict[str, NDArray[Any]] = {name: file.get_tensor(name) for name in types}
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except SafetensorError as error:
        raise MapFileError(f"{path}: expected an undamaged saved run: {error}") from error
    if metadata.get("crc32") != _checksum(arrays):
        raise MapFileError(f"{path}: expected an undamaged saved run, but its checksum does not match")
    for name, array in arrays.items():
        if array.dtype == np.bool_ and array.view(np.uint8).max(initial=0) > 1:
            raise MapFileError(f"{path}: expected an undamaged saved run, but array {name} has invalid booleans")
        array.flags.writeable = False
    return arrays


def _require_header(path: Path) -> None:
    """Raise MapFileError unless the file begins with the length of a header that fits into it."""
    if not path.is_file():
        raise MapFileError(f"{path}: expected the file of a saved run, got none")
    with path.open("rb") as file:
        length = int.from_bytes(file.read(_LENGTH_BYTES), "little")
        is_json = file.read(1) == b"{"
    if not is_json or length > min(path.stat().st_size - _LENGTH_BYTES, _MAX_HEADER_BYTES):
        raise MapFileError(f"{path}: expected the file of a saved run, got another kind of file, or part of one")


def _require_version(path: Path, metadata: dict[str, str]) -> None:
    if metadata.get("format") != FORMAT:
        raise MapFileError(f"{path}: expected the file of a saved run, got another kind of file")
    if metadata.get("version") != VERSION:
        raise MapFileError(f"{path}: expected a saved run of version {VERSION}, got {metadata.get('version')!r:.40}")


def _checksum(arrays: State) -> str:
    crc = 0
    for name, array in sorted(arrays.items()):
        crc = zlib.crc32(f"{name} {array.dtype.str} {array.shape}\n".encode(), crc)
        crc = zlib.crc32(array.reshape(-1).view(np.uint8).data, crc)
    return f"{crc:08x}"
