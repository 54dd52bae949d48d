"""Open the SQLite file of a store: schema, the lock of one server, and errors in plain words."""

from __future__ import annotations

import fcntl
import os
import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gausslite.domain.errors import StorageError

SCHEMA_VERSION = 6
PAGE_BYTES = 4096
RESTORE_ADVICE = (
    "restore a backup (gausslite-fusion-server restore BACKUP STORE), or delete the damaged rows "
    "(gausslite-fusion-server verify --repair STORE), and the agents send again what is missing"
)
_APPLICATION_ID = 0x47534C54  # "GSLT", to recognise other programs' databases
# 32 MiB: smaller logs are copied into the file so often that acknowledgements wait
_CHECKPOINT_PAGES = 8192
_SCHEMA = """
CREATE TABLE voxel_updates (
    agent_id TEXT NOT NULL, voxel INTEGER NOT NULL, update_seq INTEGER NOT NULL,
    kappa_sum INTEGER NOT NULL, count INTEGER NOT NULL, checksum INTEGER NOT NULL, gaussians BLOB NOT NULL,
    PRIMARY KEY (agent_id, voxel));
CREATE TABLE sessions (session_id TEXT PRIMARY KEY, agent_id TEXT NOT NULL UNIQUE);
CREATE TABLE keyframes (
    agent_id TEXT NOT NULL, frame_index INTEGER NOT NULL, checksum INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (agent_id, frame_index));
CREATE TABLE records (
    name TEXT NOT NULL, agent_id TEXT NOT NULL, checksum INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (name, agent_id));
CREATE TABLE properties (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE mission_config (
    only INTEGER PRIMARY KEY CHECK (only = 1),
    mission_id TEXT NOT NULL, world_frame TEXT NOT NULL, voxel_size_m REAL NOT NULL);
"""


class StoreLock:
    """Held by the one process that may write a store; readers such as a backup need none. Ends with the process."""

    def __init__(self, path: Path) -> None:
        """Raises StorageError if another process holds the lock, or the folder is not writable."""
        try:
            self._file = os.open(f"{path}-lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StorageError(
                f"store {path}: cannot be opened ({error.strerror}); expected a file in a writable folder"
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            raise StorageError(f"store {path}: in use by another server; give each its own file") from error

    def release(self) -> None:
        """Let another process open the store."""
        os.close(self._file)


def open_existing(path: Path) -> sqlite3.Connection:
    """Connect to a store and check its header and its schema; rows are not read. Raises StorageError."""
    if not path.is_file():
        raise StorageError(f"store {path}: expected a GaussLite store, got no file")
    if path.stat().st_size == 0:
        raise StorageError(
            f"store {path}: expected a GaussLite store, got an empty file; restore a backup, or remove the file to "
            "begin with an empty store"
        )
    db = connect(path)
    try:
        with storage_errors(path):
            if db.execute("PRAGMA application_id").fetchone()[0] != _APPLICATION_ID:
                raise StorageError(f"store {path}: expected a GaussLite store, got another program's database")
            version = db.execute("PRAGMA user_version").fetchone()[0]
            if version != SCHEMA_VERSION:
                raise StorageError(
                    f"store {path}: expected schema version {SCHEMA_VERSION}, got {version} of another release; use "
                    "that release, or another file, and the agents send their updates again"
                )
    except BaseException:
        db.close()
        raise
    return db


def open_or_create(path: Path) -> sqlite3.Connection:
    """Connect to a store for writing; a missing file is created. Raises StorageError."""
    is_new = not path.exists()
    db = connect(path) if is_new else open_existing(path)
    try:
        with storage_errors(path):
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute(f"PRAGMA wal_autocheckpoint = {_CHECKPOINT_PAGES}")
            if is_new:
                header = f"PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
                db.executescript(f"BEGIN IMMEDIATE; {header} {_SCHEMA} COMMIT;")
                renew_incarnation(db)
    except BaseException:
        db.close()
        raise
    return db


def renew_incarnation(db: sqlite3.Connection) -> None:
    """Give the content a new id, so that the agents compare digests."""
    db.execute("INSERT OR REPLACE INTO properties VALUES ('incarnation_id', ?)", (secrets.token_hex(16),))


def remove_store(path: Path) -> None:
    """Delete a store that no process uses, with its log and its lock."""
    for suffix in ("", "-wal", "-shm", "-lock"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def connect(path: Path) -> sqlite3.Connection:
    """Return a connection for any thread that begins and ends transactions itself. Raises StorageError."""
    try:
        return sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
    except sqlite3.Error as error:
        raise StorageError(f"store {path}: cannot be opened ({error}); expected a file in a writable folder") from error


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Convert SQLite's errors."""
    try:
        yield
    except sqlite3.Error as error:
        raise StorageError(f"store {path}: {_explain(error)}") from error


def _explain(error: sqlite3.Error) -> str:
    text = str(error)
    if "not a database" in text or "malformed" in text:
        return f"expected an undamaged GaussLite store ({text}); restore a backup"
    if "locked" in text:
        return "in use by another program; try again when it has ended"
    if "full" in text:
        return "no space left (disk full or the store's size limit); nothing of this message was stored"
    return f"refused ({text})"
