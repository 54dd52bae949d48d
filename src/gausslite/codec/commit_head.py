"""Remember beside a SQLite file how many commits it has had, so that a lost log is noticed.

SQLite takes a missing, cut or damaged log for the end of the commits, and the file seems whole. So each commit counts
itself in the file, and after it the head has the count and the name of the content. The head is not synchronised: after
a power failure it may be behind the commits, never ahead of synchronised ones.
"""

from __future__ import annotations

import os
import zlib
from contextlib import suppress
from pathlib import Path

COUNT_COMMIT = """
INSERT INTO properties VALUES ('commits', 1) ON CONFLICT (name) DO UPDATE SET value = value + 1
"""
"""The last statement of each commit."""


class CommitHead:
    """Owns the file PATH-head; without a path there is none. Not thread-safe."""

    def __init__(self, path: Path | None) -> None:
        self._path = None if path is None else Path(f"{path.resolve()}-head")
        self._file: int | None = None

    def read(self) -> tuple[str, int] | None:
        """Return the name of the content and its commits; None without the file, or for a damaged one."""
        try:
            data = b"" if self._path is None else self._path.read_bytes()
            name, commits = data.decode("ascii").split()[:2]
            return (name, int(commits)) if data == _record(name, int(commits)) else None
        except (OSError, ValueError):
            return None

    def write(self, name: str, commits: int) -> None:
        """Replace both, in a file that the first call makes. A head that cannot be written stays behind the commits."""
        with suppress(OSError):
            if self._file is None and self._path is not None:
                self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            if self._file is not None:
                os.pwrite(self._file, _record(name, commits), 0)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _record(name: str, commits: int) -> bytes:
    record = f"{name} {commits:020d} ".encode()
    return record + f"{zlib.crc32(record):08x}\n".encode()
