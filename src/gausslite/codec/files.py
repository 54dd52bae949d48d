"""Put a file in its place whole or not at all, so that no reader ever sees half of one."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from gausslite.errors import StorageError


def write_atomic(path: Path, data: bytes) -> None:
    """Write beside `path` first, then put it in its place.

    Raises StorageError naming the file when the folder cannot be written or the disk is full.
    """
    write_atomic_parts(path, [data])


def write_atomic_parts(path: Path, parts: Iterable[bytes | memoryview]) -> None:
    """As `write_atomic`, for what need not be in memory twice."""
    temporary: Path | None = None
    try:
        if path.exists() and not path.is_file():
            # a device or a pipe must be written to, never replaced
            with path.open("wb") as device:
                device.writelines(parts)
            return
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            temporary = Path(file.name)
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from error
