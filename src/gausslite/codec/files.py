"""Write files atomically, so that a reader never sees a partial file."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from gausslite.domain.errors import StorageError


def write_atomic(path: Path, data: bytes) -> None:
    """Write the bytes to a temporary file in the same folder, then rename it to `path`.

    A device or pipe is written to directly. Raises StorageError if the folder is not writable or the disk is full.
    """
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
    except OSError as error:
        raise _cannot_write(path, error) from error
    write_atomic_with(path, lambda temporary: temporary.write_bytes(data))


def write_atomic_with(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file in the same folder, then rename it to `path`.

    Raises StorageError if `path` is not a regular file, the folder is not writable or the disk is full.
    """
    temporary: Path | None = None
    try:
        if path.exists() and not path.is_file():
            raise StorageError(f"{path}: expected a regular file or none, got something else")
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(descriptor)
        temporary = Path(name)
        write(temporary)
        _flush_to_disk(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise


def _flush_to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _cannot_write(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{path}: cannot be written: {error.strerror or error}")
