"""One copy of a shard: the primary runs the calls and ships its log to the standby before it acknowledges."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from threading import RLock
from typing import Any, Protocol, runtime_checkable

from gausslite.cluster.journal import Journal, JournalEntry, changes_of
from gausslite.cluster.session_fence import SessionFence
from gausslite.cluster.store_calls import JOURNAL, READS, WRITES, LogEntry, LogPosition, StoreCall, StoreReply
from gausslite.domain.errors import GaussLiteError, InvalidInputError, StorageError, UnavailableError
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store_maintenance import back_up


class EpochError(UnavailableError):
    """The replica is not the primary of this epoch; the directory knows which one is."""


@runtime_checkable
class Standby(Protocol):
    """Receives the log of a primary. Both methods raise UnavailableError if it cannot be reached."""

    def follow(self, epoch: int) -> LogPosition:
        """Become the standby of this epoch; returns the position of its content."""
        ...

    def append(self, entry: LogEntry) -> None:
        """Store one entry, durably on return. Raises EpochError, and GaussLiteError if the entry does not follow."""
        ...


DropStandby = Callable[[int], bool]
"""Asks whether the primary of this epoch may go on without its standby; False if another primary has begun."""


class ShardReplica:
    """Owns one file of a shard, as its primary or as its standby. Thread-safe.

    A write is durable here, then durable in the standby, then acknowledged. So either file has every acknowledged
    write. A standby refuses entries of an earlier epoch, and a primary without its standby must ask before it goes on:
    a primary that has been replaced can acknowledge nothing. The journal has what both files have, so no server follows
    a write that a failover takes back.
    """

    def __init__(self, path: Path, max_bytes: int | None = None) -> None:
        """Open the file. Raises StorageError."""
        self._path = path
        self._store = SqliteStore(path, max_bytes)
        self._journal = Journal(self._store.log_position)
        self._fence = SessionFence(self._store.sessions())
        self._lock = RLock()
        self._epoch = 0
        self._is_primary = False
        self._standby: Standby | None = None
        self._drop_standby: DropStandby = _refuse
        # the writes since the start of a copy for a new standby; None without one
        self._unshipped: list[LogEntry] | None = None

    def lead(self, epoch: int, drop_standby: DropStandby) -> LogPosition:
        """Become the primary of this epoch, without a standby. Raises EpochError if the epoch is not a later one."""
        with self._lock:
            if epoch <= self._epoch:
                raise EpochError(f"shard {self._path.name}: expected an epoch above {self._epoch}, got {epoch}")
            self._epoch, self._is_primary, self._drop_standby = epoch, True, drop_standby
            self._standby, self._unshipped = None, None
            return self._position()

    def follow(self, epoch: int) -> LogPosition:
        """Become the standby of this epoch; returns the position of the content. Raises EpochError."""
        with self._lock:
            if epoch < self._epoch:
                raise EpochError(f"shard {self._path.name}: expected an epoch of at least {self._epoch}, got {epoch}")
            self._epoch, self._is_primary = epoch, False
            return self._position()

    def append(self, entry: LogEntry) -> None:
        """Store an entry of the primary's log. Raises EpochError, InvalidInputError, StorageError."""
        with self._lock:
            if self._is_primary or entry.position.epoch != self._epoch:
                raise EpochError(
                    f"shard {self._path.name}: expected entries of epoch {self._epoch} as a standby, "
                    f"got one of {entry.position.epoch}"
                )
            if entry.position != self._position():
                raise InvalidInputError(
                    f"shard {self._path.name}: expected the entry after {self._position()}, got {entry.position}"
                )
            self._record(entry.call, self._write(entry.call))

    def call(self, epoch: int, call: StoreCall) -> StoreReply:
        """Run a call as the primary of this epoch.

        Raises EpochError, JournalGapError, SessionUnknownError for data of a session that has ended, and the errors of
        the store.
        """
        if call.method in READS:
            self._require_primary(epoch)
            return StoreReply(self._run(call), LogPosition(epoch, self._store.log_position))
        with self._lock:
            self._require_primary(epoch)
            if call.method == JOURNAL:
                return StoreReply(self._journal.after(*call.arguments), self._position())
            self._fence.require_open(call)
            before = self._position()
            result = self._write(call)
            if self._position() != before:
                self._ship(LogEntry(before, call))
                self._record(call, result)
            return StoreReply(result, self._position())

    def leads(self, epoch: int) -> bool:
        """Return whether this is the primary of this epoch, at once also during a write."""
        return self._is_primary and epoch == self._epoch

    def copy_to(self, path: Path) -> None:
        """Make the file of a new standby, while writes go on; `attach` completes it. Raises StorageError."""
        with self._lock:
            self._unshipped = []
        back_up(self._path, path)

    def attach(self, epoch: int, standby: Standby) -> LogPosition:
        """Ship what was written since the copy and keep the standby up to date from now on.

        Raises EpochError, UnavailableError if the standby cannot be reached, StorageError if its file is not the copy.
        """
        with self._lock:
            self._require_primary(epoch)
            if self._unshipped is None:
                raise InvalidInputError(f"shard {self._path.name}: expected a copy before a standby is attached")
            copied = standby.follow(epoch)
            for entry in self._unshipped:
                if entry.position.transactions >= copied.transactions:
                    standby.append(entry)
            reached = standby.follow(epoch)
            if reached != self._position():
                raise StorageError(
                    f"shard {self._path.name}: expected a standby with everything up to {self._position()}, got "
                    f"{reached}; do all machines see the same folder?"
                )
            self._standby, self._unshipped = standby, None
            return self._position()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._store.close()

    def _write(self, call: StoreCall) -> Any:
        result = self._run(call)
        self._fence.record(call)
        return result

    def _record(self, call: StoreCall, result: Any) -> None:
        self._journal.record(JournalEntry(self._store.log_position, call.origin, changes_of(call, result)))

    def _run(self, call: StoreCall) -> Any:
        if call.method not in READS and call.method not in WRITES:
            raise InvalidInputError(f"store call: expected a method of a store, got {call.method!r}")
        member = getattr(self._store, call.method)
        return member(*call.arguments) if callable(member) else member

    def _ship(self, entry: LogEntry) -> None:
        """Send an entry to the standby, or go on without it if the directory agrees. Raises EpochError."""
        if self._unshipped is not None:
            self._unshipped.append(entry)
        if self._standby is None:
            return
        with contextlib.suppress(GaussLiteError):
            self._standby.append(entry)
            return
        if not self._drop_standby(self._epoch):
            self._is_primary = False
            raise EpochError(f"shard {self._path.name}: another primary has replaced this one")
        self._standby = None

    def _require_primary(self, epoch: int) -> None:
        if not self.leads(epoch):
            raise EpochError(f"shard {self._path.name}: not the primary of epoch {epoch}")

    def _position(self) -> LogPosition:
        return LogPosition(self._epoch, self._store.log_position)


def _refuse(_epoch: int) -> bool:
    return False
