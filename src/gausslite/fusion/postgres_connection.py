"""A connection to the PostgreSQL database of a store: opened again when it is lost, errors in plain words."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import RLock
from typing import Any, TypeVar

import psycopg
from psycopg.conninfo import conninfo_to_dict

from gausslite.domain.errors import InvalidInputError, StorageError

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
        self._lock = RLock()
        self._db: Database | None = None
        self._delay_s, self._next_try_s, self._failure = 0.0, 0.0, ""
        self._open()

    def run(self, work: Callable[[Database], _Result]) -> _Result:
        """Return the result of the work. It runs again if the connection is lost, so it must be safe to repeat.

        Raises StorageError.
        """
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
            db = psycopg.connect(**self._parameters, autocommit=True)
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
