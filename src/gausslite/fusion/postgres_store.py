"""The store of voxel updates in a PostgreSQL database: acknowledged updates are committed there."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from threading import RLock
from typing import Any

import psycopg
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.errors import StorageError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.postgres_connection import Database, PostgresConnection, database_name
from gausslite.fusion.store import (
    AgentTotals,
    MissionConfig,
    PutOutcome,
    SessionRecord,
    StoredScores,
    VoxelScoreTable,
    require_storable,
)
from gausslite.fusion.store_migration import rows_of_voxels
from gausslite.fusion.store_rows import Places, UpdateLog, data_checksum, read_batches, require_intact

SCHEMA_VERSION = 2
_VOXEL_ROWS_VERSION = 1
"""Had one row a voxel; such a database is converted when a server opens it."""
_LOCK = 0x47534C54  # "GSLT"; the database's other programs use other numbers
_UPDATES_SCHEMA = """
CREATE TABLE gausslite.voxel_updates (
    number BIGINT PRIMARY KEY, agent_id TEXT NOT NULL, checksum BIGINT NOT NULL, voxels BYTEA NOT NULL);
ALTER TABLE gausslite.voxel_updates ALTER COLUMN voxels SET STORAGE EXTERNAL;
"""
_SCHEMA = """
CREATE SCHEMA gausslite;
CREATE TABLE gausslite.sessions (session_id TEXT PRIMARY KEY, agent_id TEXT NOT NULL UNIQUE);
CREATE TABLE gausslite.keyframes (
    agent_id TEXT NOT NULL, frame_index BIGINT NOT NULL, checksum BIGINT NOT NULL, data BYTEA NOT NULL,
    PRIMARY KEY (agent_id, frame_index));
CREATE TABLE gausslite.records (
    name TEXT NOT NULL, agent_id TEXT NOT NULL, checksum BIGINT NOT NULL, data BYTEA NOT NULL,
    PRIMARY KEY (name, agent_id));
CREATE TABLE gausslite.properties (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE gausslite.mission_config (
    number INTEGER PRIMARY KEY CHECK (number = 1),
    mission_id TEXT NOT NULL, world_frame TEXT NOT NULL, voxel_size_m DOUBLE PRECISION NOT NULL);
ALTER TABLE gausslite.keyframes ALTER COLUMN data SET STORAGE EXTERNAL;
"""
# one statement a transaction, with its rows as arrays: a statement a row takes 1.5 to 2 times as long
_INSERT = """
INSERT INTO gausslite.voxel_updates SELECT * FROM unnest(%s::bigint[], %s::text[], %s::bigint[], %b::bytea[])
"""
_DELETE = "DELETE FROM gausslite.voxel_updates WHERE number = ANY(%s::bigint[])"
_SELECT_UPDATES = "SELECT number, agent_id, checksum, voxels FROM gausslite.voxel_updates"
_SELECT_ROWS = f"{_SELECT_UPDATES} WHERE number = ANY(%s::bigint[])"
_SET_PROPERTY = """
INSERT INTO gausslite.properties VALUES (%s, %s) ON CONFLICT (name) DO UPDATE SET value = excluded.value
"""
# changes when a standby takes over or a backup is restored, and then something acknowledged may be missing
_SELECT_TIMELINE = "SELECT substr(pg_walfile_name(pg_current_wal_lsn()), 1, 8)"


class PostgresStore:
    """A FusionStore in the schema `gausslite` of a database: one transaction per call, one server at a time.

    An advisory lock, which ends with the connection, keeps other servers out. The totals of all updates are in memory
    (ScoreIndex). Reads use a second connection and so do not wait for a commit. A lost connection is opened again,
    with the lock, if nobody else has written and no commit is missing. The constructor reads and checks every row.
    It raises InvalidInputError for an address that cannot be read, StorageError if the database cannot be reached, is
    in use by another server, is damaged, or has another schema.
    """

    def __init__(self, url: str) -> None:
        self._name = database_name(url)
        self._write_lock, self._index_lock = RLock(), RLock()
        self._log = UpdateLog()
        # identify the content of the database: this opening, and the number of transactions since
        self._opening, self._commits = "", 0
        with ExitStack() as opened:
            self._writer = PostgresConnection(url, self._take_over)
            opened.callback(self._writer.close)
            self._reader = PostgresConnection(url, lambda _: None)
            opened.callback(self._reader.close)
            self._reader.run(self._load)
            self._opened = opened.pop_all()

    @property
    def incarnation_id(self) -> str:
        """The id made with the tables, and the database's timeline when the store was opened."""
        return self._incarnation_id

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message in one transaction. Raises InvalidInputError, StorageError."""
        return self.put_all([StoredSubset.exact(subset)])[0]

    def put_all(self, updates: Sequence[StoredSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction. Raises InvalidInputError, StorageError."""
        for update in updates:
            require_storable(update)
        with self._write_lock:
            change = self._log.plan(updates, self._read_rows)
            if change.rows:
                columns = list(map(list, zip(*change.rows, strict=True)))

                def write(db: Database) -> None:
                    if change.deleted:
                        db.execute(_DELETE, (change.deleted,))
                    db.execute(_INSERT, columns)

                self._write(write)
                with self._index_lock:
                    self._log.apply(change)
        return change.outcomes

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""

        def delete(db: Database) -> None:
            db.execute(_DELETE, (self._log.rows_of(agent_id),))
            for table in ("keyframes", "records"):
                db.execute(f"DELETE FROM gausslite.{table} WHERE agent_id = %s", (agent_id,))  # noqa: S608 - constants

        with self._write_lock:
            self._write(delete)
            with self._index_lock:
                return self._log.remove_agent(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._log.index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._index_lock:
            return self._log.index.totals(agent_id)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._index_lock:
            return self._log.index.digests(agent_id)

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        with self._index_lock:
            return self._log.index.stored(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._index_lock:
            return self._log.index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        return self._batches(lambda: (agent_id,), keys)[agent_id]

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        return self._batches(lambda: self._log.index.agents, keys)

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        rows = self._read("SELECT mission_id, world_frame, voxel_size_m FROM gausslite.mission_config")
        return MissionConfig(*rows[0]) if rows else None

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        values = mission_config.mission_id, mission_config.world_frame, mission_config.voxel_size_m
        self._write_row("mission_config", "number", ("mission_id", "world_frame", "voxel_size_m"), (1, *values))

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        rows = self._read("SELECT session_id, agent_id FROM gausslite.sessions")
        return tuple(sorted((SessionRecord(*row) for row in rows), key=lambda session: session.session_id))

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        self._write_row("sessions", "agent_id", ("session_id",), (session.agent_id, session.session_id))

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        self._write(lambda db: db.execute("DELETE FROM gausslite.sessions WHERE session_id = %s", (session_id,)))

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        row = agent_id, index, data_checksum(agent_id, index, data), data
        self._write_row("keyframes", "agent_id, frame_index", ("checksum", "data"), row)

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        query = "DELETE FROM gausslite.keyframes WHERE agent_id = %s AND frame_index = ANY(%s::bigint[])"
        values = agent_id, list(indices)
        self._write(lambda db: db.execute(query, values))

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = {}
        query = "SELECT agent_id, frame_index, octet_length(data) FROM gausslite.keyframes"
        for agent_id, index, size in self._read(query):
            sizes.setdefault(agent_id, {})[index] = size
        return sizes

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist. Raises StorageError for a damaged one."""
        query = "SELECT data, checksum FROM gausslite.keyframes WHERE agent_id = %s AND frame_index = %s"
        for data, checksum in self._read(query, (agent_id, index)):
            if data_checksum(agent_id, index, data) != checksum:
                raise self._damaged(f"keyframe {index} of agent {agent_id!r}")
            return bytes(data)
        return b""

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        row = name, agent_id, data_checksum(agent_id, name, data), data
        self._write_row("records", "name, agent_id", ("checksum", "data"), row)

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one. Raises StorageError for a damaged one."""
        rows = self._read("SELECT agent_id, data, checksum FROM gausslite.records WHERE name = %s", (name,))
        for agent_id, data, checksum in rows:
            if data_checksum(agent_id, name, data) != checksum:
                raise self._damaged(f"record {name!r} of agent {agent_id!r}")
        return {agent_id: data for agent_id, data, _ in rows}

    def close(self) -> None:
        """Close the connections, which frees the database for another server."""
        with self._write_lock:
            self._opened.close()

    def _take_over(self, db: Database) -> None:
        """Lock the database for this server; at the first time create the tables. Raises StorageError."""
        try:
            with db.transaction():
                # the connection of a server that was killed may take a moment to end
                db.execute("SET LOCAL lock_timeout = '2s'")
                db.execute("SELECT pg_advisory_lock(%s)", (_LOCK,))
        except psycopg.errors.LockNotAvailable as error:
            text = f"store {self._name}: in use by another server; give each its own database"
            raise StorageError(text) from error
        if self._opening:
            self._require_unchanged(db)
        else:
            with db.transaction():
                self._create_or_check(db)
                opening = secrets.token_hex(16)
                db.execute(_SET_PROPERTY, ("position", _position(opening, 0)))
            self._opening = opening

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

    def _create_or_check(self, db: Database) -> None:
        if db.execute("SELECT to_regclass('gausslite.properties')").fetchone() == (None,):
            db.execute(_SCHEMA)
            db.execute(_UPDATES_SCHEMA)
            db.execute(_SET_PROPERTY, ("schema_version", str(SCHEMA_VERSION)))
            db.execute(_SET_PROPERTY, ("incarnation_id", secrets.token_hex(16)))
        if _property(db, "schema_version") == str(_VOXEL_ROWS_VERSION):
            self._convert(db)
        version = _property(db, "schema_version")
        if version != str(SCHEMA_VERSION):
            raise StorageError(
                f"store {self._name}: expected schema version {SCHEMA_VERSION}, got {version} of another release; use "
                "that release, or another database, and the agents send their updates again"
            )

    def _convert(self, db: Database) -> None:
        """Write the rows of a database with one row a voxel as those of this version."""
        db.execute("ALTER TABLE gausslite.voxel_updates RENAME TO voxel_rows")
        db.execute("ALTER INDEX gausslite.voxel_updates_pkey RENAME TO voxel_rows_pkey")
        db.execute(_UPDATES_SCHEMA)
        with db.cursor("convert", binary=True) as cursor:
            cursor.execute('SELECT * FROM gausslite.voxel_rows ORDER BY agent_id COLLATE "C", voxel')
            for row in rows_of_voxels(cursor, self._damaged):
                db.execute("INSERT INTO gausslite.voxel_updates VALUES (%s, %s, %s, %s)", row)
        db.execute("DROP TABLE gausslite.voxel_rows")
        db.execute(_SET_PROPERTY, ("schema_version", str(SCHEMA_VERSION)))

    def _load(self, db: Database) -> None:
        """Check every row of updates and fill the index; read the id of the content."""
        with db.transaction(), db.cursor("load", binary=True) as cursor:
            cursor.execute(f"{_SELECT_UPDATES} ORDER BY number")
            self._log.load(require_intact(cursor, self._damaged))
        timeline = db.execute(_SELECT_TIMELINE).fetchone()
        self._incarnation_id = f"{_property(db, 'incarnation_id')}-{'' if timeline is None else timeline[0]}"

    def _batches(
        self, agents: Callable[[], tuple[str, ...]], keys: Int64[ndarray, " k"] | None
    ) -> dict[str, VoxelBatch]:
        def locate() -> dict[str, Places]:
            with self._index_lock:
                return {agent_id: self._log.places(agent_id, keys) for agent_id in agents()}

        return read_batches(locate, self._read_rows)

    def _read_rows(self, numbers: Sequence[int]) -> dict[int, bytes]:
        rows = self._read(_SELECT_ROWS, (numbers,))
        return {row[0]: row[3] for row in require_intact(rows, self._damaged)}

    def _damaged(self, what: str) -> StorageError:
        return StorageError(
            f"store {self._name}: {what} is damaged (its checksum does not match); restore a backup of the database, "
            "or delete the row, and the agents send again what is missing"
        )

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        return self._reader.run(lambda db: db.execute(query, values, binary=True).fetchall())

    def _write(self, work: Callable[[Database], object]) -> None:
        """Do the work in one transaction, without waiting for the answer to each statement. Raises StorageError."""

        def commit(db: Database) -> None:
            with db.pipeline(), db.transaction():
                work(db)
                db.execute(_SET_PROPERTY, ("position", _position(self._opening, self._commits + 1)))
            self._commits += 1

        with self._write_lock:
            self._writer.run(commit)

    def _write_row(self, table: str, key: str, columns: Sequence[str], row: tuple[Any, ...]) -> None:
        """Insert a row, or replace the columns of the one with its key."""
        places, newer = ", ".join(["%s"] * len(row)), ", ".join(f"{name} = excluded.{name}" for name in columns)
        query = f"""
            INSERT INTO gausslite.{table} ({key}, {", ".join(columns)}) VALUES ({places})
            ON CONFLICT ({key}) DO UPDATE SET {newer}
        """  # noqa: S608 - the names are constants
        self._write(lambda db: db.execute(query, row))


def _position(opening: str, commits: int) -> str:
    return f"{opening}:{commits}"


def _property(db: Database, name: str) -> str | None:
    row = db.execute("SELECT value FROM gausslite.properties WHERE name = %s", (name,)).fetchone()
    return None if row is None else str(row[0])
