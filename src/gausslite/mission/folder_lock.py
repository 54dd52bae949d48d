"""Keep two runs from writing their results into one folder."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gausslite.domain.errors import StorageError
from gausslite.mission.results import prepare_folder


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold the folder for this run; it is created, and removed if it is empty at the end.

    Raises StorageError if another run holds it.
    """
    prepare_folder(folder)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        raise StorageError(f"{folder}: another run writes its results there; choose another --out") from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()
        os.close(handle)
