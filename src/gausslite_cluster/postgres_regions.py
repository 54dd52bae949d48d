"""Share a PostgreSQL database among servers: each holds advisory locks on its slots, which end with its connection.

The locks alone state which server owns what: `owners` reads them. All rows of a slot are written by the connection
that holds the slot's lock, so a server that has lost its connection cannot write what another server owns by now.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection

from gausslite.domain.errors import StorageError, UnavailableError
from gausslite_cluster.postgres_store import (
    LOCK,
    Database,
    PostgresConnection,
    PostgresStore,
    begin_opening,
    create_or_check,
    database_name,
    locking,
)
from gausslite_cluster.regions import OwnedSlots, Owners

_SLOT_LOCKS = 0x47534C53  # "GSLS"
_OWNERS = """
SELECT servers.address, string_agg(locks.objid::text, ',' ORDER BY locks.objid) FILTER (WHERE locks.classid <> 0)
FROM pg_locks AS locks JOIN gausslite.servers AS servers USING (pid)
WHERE locks.locktype = 'advisory' AND locks.granted
    AND locks.database = (SELECT oid FROM pg_database WHERE datname = current_database())
    AND (locks.classid = 0 AND locks.objid = %s AND locks.objsubid = 1 OR locks.classid = %s AND locks.objsubid = 2)
GROUP BY servers.address ORDER BY servers.address
"""
_DELETE_ENDED = """
DELETE FROM gausslite.servers
WHERE pid = pg_backend_pid() OR pid NOT IN (SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND granted)
"""
_REGISTER = "INSERT INTO gausslite.servers VALUES (pg_backend_pid(), %s)"
_TAKE = "SELECT slot FROM unnest(%s::integer[]) AS slot WHERE pg_try_advisory_lock(%s, slot)"
_RELEASE = "SELECT pg_advisory_unlock(%s, slot) FROM unnest(%s::integer[]) AS slot"


class SharedSlots:
    """Owns this server's connection with its locks. Thread-safe.

    server: the address under which the other servers reach this one. Raises InvalidInputError, StorageError.
    """

    def __init__(self, url: str, server: str) -> None:
        self._url, self._name, self.server = url, database_name(url), server
        self._holder: Database | None = None
        self.connection = 0
        """The number of the connection that holds the locks."""
        self.held: frozenset[int] = frozenset()
        """The slots whose locks this server has."""
        self._rows: list[tuple[str, str | None]] = []
        self._owners = Owners()
        self._locks = PostgresConnection(url, self._enter)

    def owners(self) -> Owners:
        """Return who owns which slot now, the same object as before if nothing has changed.

        A lost connection is opened again, without locks. Raises StorageError.
        """
        rows = self._locks.run(lambda db: db.execute(_OWNERS, (LOCK, _SLOT_LOCKS)).fetchall())
        if rows != self._rows:
            server_of = {int(slot): address for address, own in rows for slot in (own or "").split(",") if slot}
            self._rows, self._owners = rows, Owners(tuple(address for address, _ in rows), server_of)
        return self._owners

    def take(self, slots: Collection[int]) -> frozenset[int]:
        """Lock those of these slots that nobody owns; returns them. Raises StorageError."""
        wanted = sorted(frozenset(slots) - self.held)
        rows = self._locks.run(lambda db: db.execute(_TAKE, (wanted, _SLOT_LOCKS)).fetchall()) if wanted else []
        taken = frozenset(slot for (slot,) in rows)
        self.held |= taken
        return taken

    def release(self, slots: Collection[int]) -> None:
        """Give these slots up; no store of theirs may be open. Raises StorageError."""
        self._locks.run(lambda db: db.execute(_RELEASE, (_SLOT_LOCKS, sorted(self.held.intersection(slots)))))
        self.held -= frozenset(slots)

    def open_store(self) -> PostgresStore:
        """Return the store of the slots that are held now. Raises StorageError."""
        return PostgresStore(self._url, OwnedSlots(self.held), functools.partial(self._write, self._holder))

    def close(self) -> None:
        """Close the connection; the locks end."""
        self._locks.close()

    def _enter(self, db: Database) -> None:
        """Become one of the servers; the slots of an earlier connection are lost. Raises StorageError."""
        self.held = frozenset()
        with locking(db, self._name):
            db.execute("SELECT pg_advisory_lock_shared(%s)", (LOCK,))
            # one after the other
            db.execute("SELECT pg_advisory_xact_lock(%s, -1)", (_SLOT_LOCKS,))
            create_or_check(db, self._name)
            db.execute(_DELETE_ENDED)
            if any(address == self.server for address, _ in db.execute(_OWNERS, (LOCK, _SLOT_LOCKS))):
                raise StorageError(f"store {self._name}: another server has the peer-address {self.server}")
            db.execute(_REGISTER, (self.server,))
            begin_opening(db)
        self._holder = db
        self.connection += 1

    def _write(self, holder: Database | None, work: Callable[[Database], object]) -> None:
        """Do the work in one transaction of the holder. Raises StorageError, UnavailableError if it was replaced."""

        def commit(db: Database) -> None:
            if db is not holder:
                raise UnavailableError("store: the connection with the locks of this server's regions was lost")
            with db.pipeline(), db.transaction():
                work(db)

        self._locks.run(commit)
