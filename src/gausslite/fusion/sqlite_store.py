"""The store of voxel updates in SQLite: in a file, where acknowledged updates survive a power failure, or in memory."""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import secrets
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

from gausslite.codec.commit_head import COUNT_COMMIT, CommitHead
from gausslite.domain.errors import StorageError
from gausslite.fusion.epochs import RECORD as EPOCH
from gausslite.fusion.migrations import Step, missing_steps
from gausslite.fusion.store import TABLES, Execute, FusionStore
from gausslite.fusion.update_log import LogChange

# lost pages take rows away without a wrong checksum: the last commit has the sum of their numbers
_ROW_SUM = "(SELECT coalesce(sum(number), 0) FROM voxel_updates)"
_log = logging.getLogger(__name__)

IN_MEMORY = Path(":memory:")
"""The name of a database that ends with its connection."""
SCHEMA_VERSION = 9
PAGE_BYTES = 4096
RESTORE_ADVICE = (
    "restore a backup (gausslite-fusion-server restore BACKUP STORE), or keep what is intact "
    "(gausslite-fusion-server verify --repair STORE), and the agents send again what is missing"
)
_APPLICATION_ID = 0x47534C54  # "GSLT", to recognise other programs' databases
_CHECKPOINT_PERIOD_S, _FREE_ROUNDS = 4.0, 3
"""The log is copied this often: first in rounds beside the commits, then the short rest while none runs."""
# 256 MiB: only where the checkpoints in the background do not keep up
_CHECKPOINT_PAGES = 65536
_SCHEMA = f"""
CREATE TABLE voxel_updates (
    number INTEGER PRIMARY KEY, agent_id TEXT NOT NULL, checksum INTEGER NOT NULL, voxels BLOB NOT NULL);
{TABLES}
"""
_DELETE = "DELETE FROM voxel_updates WHERE number = ?"
_ADD_TO_SUM = "UPDATE properties SET value = value + ? WHERE name = 'row_sum'"
_INSERT = "INSERT INTO voxel_updates VALUES (?, ?, ?, ?)"
SELECT_UPDATES = "SELECT number, agent_id, checksum, voxels FROM voxel_updates"
"""UpdateRows."""
_SELECT_ROWS = f"{SELECT_UPDATES} WHERE number IN (SELECT value FROM json_each(?))"  # noqa: S608
_CHECKPOINT = "PRAGMA wal_checkpoint(PASSIVE)"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of the one process that may write a store; readers such as a backup need none.

    It belongs to the file: symbolic links are followed, and a file with several names is refused. It ends with the
    process. Raises StorageError if another process holds it, or the folder is not writable.
    """
    if path.is_file() and path.stat().st_nlink > 1:
        raise StorageError(
            f"store {path}: expected a file with one name, got {path.stat().st_nlink} (hard links); another server "
            "could write it under another name: delete the others, or copy the file"
        )
    try:
        file = Path(f"{path.resolve()}-lock").open("ab")  # noqa: SIM115 - closed below
    except OSError as error:
        raise StorageError(
            f"store {path}: cannot be opened ({error.strerror}); expected a file in a writable folder"
        ) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StorageError(f"store {path}: in use by another server; give each its own file") from error
        yield


def open_existing(path: Path, may_be_earlier: bool = False) -> sqlite3.Connection:
    """Connect to a store and check its header and its schema version; rows are not read. Raises StorageError.

    may_be_earlier: of one of the schemas that `bring_forward` knows.
    """
    if not path.is_file():
        raise StorageError(f"store {path}: expected a GaussLite store, got no file")
    with ExitStack() as opened, storage_errors(path):
        db = opened.enter_context(contextlib.closing(connect(path)))
        if db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0:
            raise StorageError(
                f"store {path}: expected a GaussLite store, got an empty file; restore a backup, or remove the file to "
                "begin with an empty store"
            )
        if db.execute("PRAGMA application_id").fetchone()[0] != _APPLICATION_ID:
            raise StorageError(f"store {path}: expected a GaussLite store, got another program's database")
        if _steps(db, path) and not may_be_earlier:
            raise StorageError(f"store {path}: of an earlier schema; a server that opens it brings it forward")
        opened.pop_all()
        return db


def bring_forward(db: sqlite3.Connection, path: Path) -> None:
    """Give a store of an earlier schema the tables of this one, in one transaction. Raises StorageError."""
    with storage_errors(path):
        db.execute("BEGIN IMMEDIATE")
        for step in _steps(db, path):
            step(db.execute)
        db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        db.execute("COMMIT")


def _steps(db: sqlite3.Connection, path: Path) -> tuple[Step, ...]:
    return missing_steps(str(path), _version(db), SCHEMA_VERSION)


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _keep_earlier(db: sqlite3.Connection, path: Path) -> None:
    """Copy a store of an earlier schema, so that its release can be used again. Raises StorageError."""
    kept = path.with_name(f"{path.name}.schema-{_version(db)}")
    kept.unlink(missing_ok=True)
    kept.touch(0o600)
    with storage_errors(path):
        db.execute("VACUUM INTO ?", (str(kept),))
    _log.warning("store %s: brought forward to schema %d; the file before is %s", path, SCHEMA_VERSION, kept)


def content_of(db: sqlite3.Connection, path: Path) -> tuple[str, int]:
    """Return the id of the content and the number of its commits. Raises StorageError."""
    properties = dict(db.execute("SELECT name, value FROM properties"))
    count = properties.get("commits", "0")
    if not properties.get("incarnation_id") or not count.isdecimal():
        raise StorageError(f"store {path}: expected its properties, got damaged ones; {RESTORE_ADVICE}")
    return properties["incarnation_id"], int(count)


def require_all_rows(db: sqlite3.Connection, path: Path) -> None:
    """Raise StorageError unless the rows of updates are those of the last commit, by the sum of their numbers."""
    query = f"SELECT value FROM properties WHERE name = 'row_sum' AND value != CAST({_ROW_SUM} AS TEXT)"  # noqa: S608
    if db.execute(query).fetchone():
        raise StorageError(f"store {path}: expected all rows of its last commit, got others; {RESTORE_ADVICE}")


def require_newest(db: sqlite3.Connection, path: Path, head: tuple[str, int] | None) -> None:
    """Raise StorageError if the store lacks commits of its head, which was read first."""
    name, commits = content_of(db, path)
    if head is not None and (head[0] != name or head[1] > commits):
        raise StorageError(
            f"store {path}: expected commit {head[1]} of content {head[0]:.8}, got commit {commits} of {name:.8}: its "
            f"log {path.name}-wal is missing or damaged, or another file is in its place; {RESTORE_ADVICE}"
        )


def _open(path: Path, opened: ExitStack) -> sqlite3.Connection:
    """Lock a store and connect to it for writing; a missing file is created. Raises StorageError."""
    if path == IN_MEMORY:
        db = opened.enter_context(contextlib.closing(connect(path)))
        _create_tables(db)
        return db
    opened.enter_context(locked(path))  # before anything is read: another server may be writing
    is_new = not path.exists()
    if is_new:
        # SQLite would delete the log, which may have the last acknowledged updates
        if Path(f"{path.resolve()}-wal").exists():
            raise StorageError(
                f"store {path}: expected the file of its log {path.name}-wal, got none; {RESTORE_ADVICE}"
            )
        create(path)
    db = opened.enter_context(contextlib.closing(open_existing(path, may_be_earlier=True)))
    with storage_errors(path):
        if _version(db) != SCHEMA_VERSION:
            _keep_earlier(db, path)
            bring_forward(db, path)
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        # freed pages are overwritten only where that costs no additional write
        db.execute("PRAGMA secure_delete = FAST")
        db.execute(f"PRAGMA wal_autocheckpoint = {_CHECKPOINT_PAGES}")
        # of a store that an earlier release made
        db.execute(f"INSERT OR IGNORE INTO properties VALUES ('row_sum', {_ROW_SUM})")  # noqa: S608
        # the head is beside the store: it shows that the store is older than what was acknowledged
        head = content_of(db, path) if is_new else CommitHead(path).read()
        require_newest(db, path, head)
        if head is None and content_of(db, path)[1]:
            renew_incarnation(db)
            _log.warning("store %s: its file %s-head is missing or damaged; agents compare all data", path, path.name)
    return db


def _create_tables(db: sqlite3.Connection) -> None:
    header = f"PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
    db.executescript(f"BEGIN IMMEDIATE; {header} {_SCHEMA} COMMIT;")
    renew_incarnation(db)


def create(path: Path) -> None:
    """Create an empty store, at once: a server that is killed meanwhile leaves no file under this name."""
    # the file behind a symbolic link, which may not exist yet
    path = path.resolve()
    new = path.with_name(path.name + "-new")
    new.unlink(missing_ok=True)
    new.touch(0o600)
    with contextlib.closing(connect(new)) as db, storage_errors(path):
        _create_tables(db)
    new.replace(path)


def renew_incarnation(db: sqlite3.Connection) -> None:
    """Give the content a new id, so that the agents compare digests; its commits are counted from here."""
    values = f"('incarnation_id', ?), ('commits', '1'), ('row_sum', {_ROW_SUM})"
    db.execute(f"INSERT OR REPLACE INTO properties VALUES {values}", (secrets.token_hex(16),))  # noqa: S608


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
    if "not a database" in text:
        return f"expected an undamaged GaussLite store ({text}); restore a backup"
    if "malformed" in text:
        return f"expected an undamaged GaussLite store ({text}); {RESTORE_ADVICE}"
    if "locked" in text:
        return "in use by another program; try again when it has ended"
    if "full" in text:
        return "no space left (disk full or the store's size limit); nothing of this message was stored"
    return f"refused ({text})"


class SqliteStore(FusionStore):
    """A FusionStore in a file: write-ahead log, synchronous=FULL, one transaction per call, one server at a time.

    Without a path it is in memory and ends with its process. The totals of all updates are in memory (ScoreIndex).
    Reads of a file use a second connection and so do not wait for a commit. max_bytes limits the file size; a put
    beyond it raises StorageError and changes nothing. The constructor reads and checks every row. It raises
    StorageError if the file cannot be opened, is in use by another server, is damaged, or has another schema.
    """

    def __init__(self, path: Path = IN_MEMORY, max_bytes: int | None = None) -> None:
        super().__init__()
        self._path = path
        with ExitStack() as opened:
            self._writer = self._reader = _open(path, opened)
            # held for a transaction, and for a query; one connection for both in memory
            self._write_lock = self._read_lock = Lock()
            if path != IN_MEMORY:
                self._read_lock = Lock()
                self._reader = opened.enter_context(contextlib.closing(connect(path)))
            if max_bytes is not None:
                self._writer.execute(f"PRAGMA max_page_count = {max(1, max_bytes // PAGE_BYTES)}")
            self._load()
            self._head = opened.enter_context(contextlib.closing(CommitHead(None if path == IN_MEMORY else path)))
            self.incarnation_id, self._commits = content_of(self._writer, path)
            self._head.write(self.incarnation_id, self._commits)
            self._opened = opened.pop_all()
        self._is_closed, self._has_commits = Event(), False
        self._checkpoints = Thread(target=self._copy_log, name="checkpoints", daemon=True)
        if path != IN_MEMORY:
            self._checkpoints.start()

    def close(self) -> None:
        """Write the log into the file and close it."""
        self._is_closed.set()
        if self._checkpoints.is_alive():
            # before the lock, for which it may wait
            self._checkpoints.join()
        with ExitStack() as held:
            for lock in dict.fromkeys((self._write_lock, self._read_lock)):
                held.enter_context(lock)
            self._opened.close()

    def _copy_log(self) -> None:
        """Copy the log into the file every few seconds, in a thread: a commit that did so would wait for the disk."""
        with contextlib.closing(connect(self._path)) as db:
            db.execute("PRAGMA synchronous = FULL")
            while not self._is_closed.wait(_CHECKPOINT_PERIOD_S):
                if self._has_commits:
                    self._has_commits = False
                    # what fails here fails in the next commit too, which says so
                    with contextlib.suppress(sqlite3.Error):
                        for _ in range(_FREE_ROUNDS):
                            db.execute(_CHECKPOINT)
                        # without commits: the log begins anew only when all of it is in the file
                        with self._write_lock:
                            db.execute(_CHECKPOINT)

    def _load(self) -> None:
        """Check every row of updates and fill the index."""
        with storage_errors(self._path):
            check = self._reader.execute("PRAGMA quick_check(1)").fetchone()[0]
            if check != "ok":
                raise StorageError(f"store {self._path}: expected an undamaged file, got {check!r}; {RESTORE_ADVICE}")
            self._log.epochs.load(self.records(EPOCH))
            rows = self._reader.execute(f"{SELECT_UPDATES} ORDER BY number")
            self._log.load(self._require_intact(rows))
            require_all_rows(self._reader, self._path)
        for (name,) in self._read("SELECT DISTINCT name FROM records"):
            self.records(name)

    def _read_rows(self, numbers: Sequence[int]) -> dict[int, bytes]:
        rows = self._read(_SELECT_ROWS, (json.dumps(numbers),))
        return {row[0]: row[3] for row in self._require_intact(rows)}

    def _damaged(self, what: str) -> StorageError:
        return StorageError(f"store {self._path}: {what} is damaged (its checksum does not match); {RESTORE_ADVICE}")

    def _write_change(self, change: LogChange, execute: Execute) -> None:
        self._delete_rows(execute, change.deleted)
        for row in change.rows:
            execute(_INSERT, row)
        execute(_ADD_TO_SUM, (sum(row[0] for row in change.rows),))

    def _delete_rows(self, execute: Execute, numbers: Iterable[int]) -> None:
        numbers = list(numbers)
        for number in numbers:
            execute(_DELETE, (number,))
        execute(_ADD_TO_SUM, (-sum(numbers),))

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._read_lock, storage_errors(self._path):
            return self._reader.execute(query, values).fetchall()

    def _write(self, work: Callable[[Execute], object]) -> None:
        with self._write_lock, storage_errors(self._path):
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                work(self._writer.execute)
                self._writer.execute(COUNT_COMMIT)
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                raise
            self._commits += 1
            self._head.write(self.incarnation_id, self._commits)
            self._has_commits = True
