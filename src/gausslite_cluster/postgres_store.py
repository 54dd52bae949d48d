"""The store of voxel updates in a PostgreSQL database: acknowledged updates are committed there.

Rows are kept by slot (`regions.py`). One server uses all slots alone, or several servers some each (SharedSlots of
`postgres_regions.py`). Each statement on updates addresses one slot, so that a distributed PostgreSQL can spread them.
A lost connection is opened again; errors are in plain words.
"""

from __future__ import annotations

import itertools
import logging
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import Any, TypeVar

import psycopg
from psycopg.conninfo import conninfo_to_dict

from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.fusion.epochs import RECORD as EPOCH
from gausslite.fusion.migrations import missing_steps
from gausslite.fusion.store import TABLES, Execute, FusionStore
from gausslite.fusion.update_log import SLOT_BITS, LogChange
from gausslite_cluster.regions import ALL_SLOTS, OwnedSlots, slots_of

_log = logging.getLogger(__name__)

_FIRST_DELAY_S, _MAX_DELAY_S = 0.1, 5.0
_PARAMETERS: dict[str, Any] = {
    "application_name": "gausslite-fusion-server",
    "connect_timeout": 5,
    # a database whose machine is gone is noticed after these seconds, not after hours
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}
_SESSION_SETTINGS = """
SET statement_timeout = '120s'; SET search_path = gausslite;
SET tcp_keepalives_idle = 10; SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3;
SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off';
"""
_Result = TypeVar("_Result")
Database = psycopg.Connection[tuple[Any, ...]]


def database_name(url: str) -> str:
    """Return where the database is, without the password. Raises InvalidInputError for an address libpq cannot read."""
    try:
        given = {name: str(value) for name, value in conninfo_to_dict(url).items()}
    except psycopg.Error:
        given = {"port": "unknown"}
    user, host, port, database = (given.get(name, "") for name in ("user", "host", "port", "dbname"))
    # neither the cause nor the parts may be printed: with an unescaped character, they have a part of the password
    if "@" in host + database or not (port == "" or port.replace(",", "").isdigit()):
        raise InvalidInputError(
            "store: expected postgresql://USER@HOST/DATABASE, got another address (in a password, @ is %40, : is %3A "
            "and / is %2F)"
        )
    return f"postgresql://{user}@{host}{port and ':' + port}/{database}"


class PostgresConnection:
    """Owns one connection. Thread-safe: one call at a time.

    prepare: called with every new connection before its first use; it may raise StorageError.
    """

    def __init__(self, url: str, prepare: Callable[[Database], None]) -> None:
        """Raises InvalidInputError for an address that cannot be read, StorageError without a connection."""
        self._name = database_name(url)
        self._parameters, self._prepare = {**_PARAMETERS, **conninfo_to_dict(url)}, prepare
        self._lock = Lock()
        self._db: Database | None = None
        self._delay_s, self._next_try_s, self._failure = 0.0, 0.0, ""
        self._open()

    def run(self, work: Callable[[Database], _Result]) -> _Result:
        """Return the result of the work, which must be safe to repeat after a lost connection. Raises StorageError."""
        with self._lock:
            try:
                return self._run(work)
            except _LostConnectionError:
                # at once, because the database may only have been restarted
                return self._run(work)

    def close(self) -> None:
        """Close the connection; its lock ends."""
        with self._lock:
            if self._db is not None:
                self._db.close()

    def _run(self, work: Callable[[Database], _Result]) -> _Result:
        if self._db is None or self._db.closed:
            self._open()
        assert self._db is not None
        try:
            return work(self._db)
        except psycopg.Error as error:
            if self._db.closed:
                raise _LostConnectionError(self._text("the connection is lost", error)) from error
            if isinstance(error, psycopg.errors.DiskFull):
                raise StorageError(f"store {self._name}: no space left; nothing of this message was stored") from error
            raise StorageError(self._text("refused", error)) from error

    def _open(self) -> None:
        wait_s = self._next_try_s - time.monotonic()
        if wait_s > 0:
            raise StorageError(f"{self._failure}; the next attempt is in {wait_s:.1f} s")
        try:
            db = self._connect()
        except StorageError as error:
            self._failure = str(error)
            self._delay_s = min(max(2 * self._delay_s, _FIRST_DELAY_S), _MAX_DELAY_S)
            self._next_try_s = time.monotonic() + self._delay_s
            raise
        self._db, self._delay_s, self._next_try_s = db, 0.0, 0.0

    def _connect(self) -> Database:
        try:
            db = psycopg.connect(**{**self._parameters, "client_encoding": "utf8"}, autocommit=True)
        except psycopg.Error as error:
            raise StorageError(self._text("not reachable", error)) from error
        try:
            db.execute(_SESSION_SETTINGS)
            self._prepare(db)
        except psycopg.Error as error:
            db.close()
            raise StorageError(self._text("refused", error)) from error
        except BaseException:
            db.close()
            raise
        return db

    def _text(self, what: str, error: psycopg.Error) -> str:
        return f"store {self._name}: {what} ({' '.join(str(error).split())})"


class _LostConnectionError(StorageError):
    """The connection ended during a call; whether a transaction was committed is unknown."""


SCHEMA_VERSION = 5
LOCK = 0x47534C54  # "GSLT"; the database's other programs use other numbers
_SCHEMA = f"""
CREATE SCHEMA gausslite;
CREATE TABLE voxel_updates (
    slot SMALLINT NOT NULL, number BIGINT NOT NULL, agent_id TEXT NOT NULL, checksum BIGINT NOT NULL,
    voxels BYTEA NOT NULL, PRIMARY KEY (slot, number));
ALTER TABLE voxel_updates ALTER COLUMN voxels SET STORAGE EXTERNAL;
CREATE TABLE servers (pid INTEGER PRIMARY KEY, address TEXT NOT NULL);
{TABLES}
ALTER TABLE keyframes ALTER COLUMN data SET STORAGE EXTERNAL;
"""
# one statement a slot, with its rows as arrays: a statement a row takes 1.5 to 2 times as long
_INSERT = """
INSERT INTO gausslite.voxel_updates
SELECT %s::smallint, * FROM unnest(%s::bigint[], %s::text[], %s::bigint[], %b::bytea[])
"""
_DELETE = "DELETE FROM gausslite.voxel_updates WHERE slot = %s::smallint AND number = ANY(%s::bigint[])"
_SELECT_UPDATES = "SELECT number, agent_id, checksum, voxels FROM gausslite.voxel_updates WHERE"
_SELECT_ROWS = f"{_SELECT_UPDATES} slot = %s::smallint AND number = ANY(%s::bigint[])"
_SELECT_EPOCHS = "SELECT agent_id, data, checksum FROM gausslite.records WHERE name = %s"
_SET_PROPERTY = """
INSERT INTO gausslite.properties VALUES (%s, %s) ON CONFLICT (name) DO UPDATE SET value = excluded.value
"""
# changes when a standby takes over or a backup is restored, and then something acknowledged may be missing
_SELECT_TIMELINE = "SELECT substr(pg_walfile_name(pg_current_wal_lsn()), 1, 8)"


Write = Callable[[Callable[[Database], object]], None]
"""Does work in one transaction, by the connection that holds the locks of this server's slots.

Raises StorageError, UnavailableError if the locks have been lost.
"""


class PostgresStore(FusionStore):
    """A FusionStore in the schema `gausslite` of a database: one transaction per call.

    Without `owned`, for one server: an advisory lock, which ends with the connection, keeps other servers out. With
    it, the store has the updates of these slots alone, and takes no others. Other servers may change the records,
    sessions and keyframes; only an agent's home deletes them.

    The totals of all updates are in memory (ScoreIndex). Reads use a second connection and so do not wait for a
    commit. A lost connection is opened again, with the lock, if nobody else has written and no commit is missing. The
    constructor reads and checks every row.
    It raises InvalidInputError for an address that cannot be read, StorageError if the database cannot be reached, is
    in use by another server, is damaged, or has another schema.
    """

    def __init__(self, url: str, owned: OwnedSlots | None = None, write_owned: Write | None = None) -> None:
        """write_owned: for a store of `owned` slots."""
        super().__init__(slots_of)
        self._name = database_name(url)
        self._owned, self._write_owned, self.is_shared = owned, write_owned, owned is not None
        # identify the content of the database: this opening, and the number of transactions since
        self._opening, self._commits = "", 0
        with ExitStack() as opened:
            if write_owned is None:
                self._writer = PostgresConnection(url, self._take_over)
                opened.callback(self._writer.close)
            self._reader = PostgresConnection(url, lambda _: None)
            opened.callback(self._reader.close)
            self._reader.run(self._load)
            self._opened = opened.pop_all()

    def close(self) -> None:
        """Close the own connections; without owned slots, this frees the database for another server."""
        with self._log_lock:
            self._opened.close()

    def _take_over(self, db: Database) -> None:
        """Lock the database for this server; at the first time create the tables. Raises StorageError."""
        with locking(db, self._name):
            db.execute("SELECT pg_advisory_lock(%s)", (LOCK,))
        if self._opening:
            self._require_unchanged(db)
        else:
            with db.transaction():
                create_or_check(db, self._name)
                self._opening = begin_opening(db)

    def _require_unchanged(self, db: Database) -> None:
        """Raise StorageError unless the database has the transactions of this server, and no other ones."""
        position = _property(db, "position")
        if position == _position(self._opening, self._commits + 1):
            # the connection was lost during this commit
            self._commits += 1
        elif position != _position(self._opening, self._commits):
            raise StorageError(
                f"store {self._name}: changed by another server, or acknowledged data is missing; restart this server"
            )

    def _load(self, db: Database) -> None:
        """Check every row of updates and fill the index; read the id of the content."""
        self._log.epochs.load(self._intact(EPOCH, db.execute(_SELECT_EPOCHS, (EPOCH,), binary=True)))
        with db.transaction(), db.cursor("load", binary=True) as cursor:
            slots = sorted(ALL_SLOTS if self._owned is None else self._owned.slots)
            cursor.execute(f"{_SELECT_UPDATES} slot = ANY(%s::smallint[]) ORDER BY slot, number", (slots,))
            self._log.load(self._require_intact(cursor))
        timeline = db.execute(_SELECT_TIMELINE).fetchone()
        self.incarnation_id = f"{_property(db, 'incarnation_id')}-{'' if timeline is None else timeline[0]}"

    def _read_rows(self, numbers: Sequence[int]) -> dict[int, bytes]:
        rows = itertools.chain.from_iterable(self._read(_SELECT_ROWS, part) for part in _by_slot(numbers))
        return {row[0]: row[3] for row in self._require_intact(rows)}

    def _damaged(self, what: str) -> StorageError:
        return StorageError(
            f"store {self._name}: {what} is damaged (its checksum does not match); restore a backup of the database, "
            "or delete the row, and the agents send again what is missing"
        )

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        return self._reader.run(lambda db: db.execute(_translated(query), values, binary=True).fetchall())

    def _is_home(self, agent_id: str) -> bool:
        return self._owned is None or self._owned.is_home(agent_id)

    def _write_change(self, change: LogChange, execute: Execute) -> None:
        self._delete_rows(execute, change.deleted)
        for slot, rows in itertools.groupby(sorted(change.rows), key=lambda row: row[0] >> SLOT_BITS):
            execute(_INSERT, (slot, *map(list, zip(*rows, strict=True))))

    def _delete_rows(self, execute: Execute, numbers: Iterable[int]) -> None:
        for slot, own in _by_slot(numbers):
            execute(_DELETE, (slot, own))

    def _write(self, work: Callable[[Execute], object]) -> None:
        """Do the work in one transaction, without waiting for the answer to each statement. Raises StorageError."""

        def execute_in(db: Database) -> None:
            work(lambda query, values: db.execute(_translated(query), values))

        if self._write_owned is not None:
            self._write_owned(execute_in)
            return

        def commit(db: Database) -> None:
            with db.pipeline(), db.transaction():
                execute_in(db)
                db.execute(_SET_PROPERTY, ("position", _position(self._opening, self._commits + 1)))
            self._commits += 1

        self._writer.run(commit)


def _translated(query: str) -> bytes:
    return query.replace("?", "%s").encode()


def _position(opening: str, commits: int) -> str:
    return f"{opening}:{commits}"


def _property(db: Database, name: str) -> str | None:
    row = db.execute("SELECT value FROM gausslite.properties WHERE name = %s", (name,)).fetchone()
    return None if row is None else str(row[0])


@contextmanager
def locking(db: Database, name: str) -> Iterator[None]:
    """Begin a transaction that takes locks of the database. Raises StorageError if another server has them."""
    try:
        with db.transaction():
            # the connection of a server that was killed may take a moment to end
            db.execute("SET LOCAL lock_timeout = '2s'")
            yield
    except psycopg.errors.LockNotAvailable as error:
        raise StorageError(
            f"store {name}: in use by another server; give each its own database, or share it: set peer-address of both"
        ) from error


def begin_opening(db: Database) -> str:
    """Record that another opening of the database begins, so that earlier ones no longer write; returns its id."""
    opening = secrets.token_hex(16)
    db.execute(_SET_PROPERTY, ("position", _position(opening, 0)))
    return opening


def create_or_check(db: Database, name: str) -> None:
    """Create the tables, or bring those of an earlier schema forward. Raises StorageError for another release's."""
    if db.execute("SELECT to_regclass('gausslite.properties')").fetchone() == (None,):
        db.execute(_SCHEMA)
        db.execute(_SET_PROPERTY, ("schema_version", str(SCHEMA_VERSION)))
        db.execute(_SET_PROPERTY, ("incarnation_id", secrets.token_hex(16)))
    version = int(_property(db, "schema_version") or 0)
    steps = missing_steps(name, version, SCHEMA_VERSION)
    if not steps:
        return
    # alone: servers that share the database are of that release
    if db.execute("SELECT pg_try_advisory_xact_lock(%s)", (LOCK,)).fetchone() != (True,):
        raise StorageError(f"store {name}: of an earlier schema and in use; end all servers, then start this one again")
    for step in steps:
        step(lambda query, values: db.execute(_translated(query), values, binary=True))
    db.execute("ALTER TABLE keyframes ALTER COLUMN data SET STORAGE EXTERNAL")
    db.execute(_SET_PROPERTY, ("schema_version", str(SCHEMA_VERSION)))
    _log.warning("store %s: brought forward from schema %d to %d", name, version, SCHEMA_VERSION)


def _by_slot(numbers: Iterable[int]) -> Iterator[tuple[int, list[int]]]:
    """Yield each slot with the numbers of its rows."""
    for slot, own in itertools.groupby(sorted(numbers), key=lambda number: number >> SLOT_BITS):
        yield slot, list(own)
