"""Decide which replica of each shard is the primary, and replace the ones that fail."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, runtime_checkable

from gausslite.cluster.store_calls import LogPosition
from gausslite.domain.errors import GaussLiteError, InvalidInputError, StorageError
from gausslite.fusion.sqlite_file import remove_store

_log = logging.getLogger(__name__)
_FILE = "directory.json"


@runtime_checkable
class ReplicaHandle(Protocol):
    """A ShardReplica in another process. Every method raises UnavailableError if it cannot be reached."""

    def lead(self, epoch: int) -> LogPosition:
        """Become the primary; it asks this directory before it drops its standby."""
        ...

    def leads(self, epoch: int) -> bool:
        """Return whether it is the primary of this epoch."""
        ...

    def copy_to(self, path: Path) -> None:
        """Make the file of a new standby."""
        ...

    def attach(self, epoch: int, standby: str) -> LogPosition:
        """Keep the standby of this name up to date from now on."""
        ...


@runtime_checkable
class ReplicaHosts(Protocol):
    """The machines that run replicas."""

    def start(self, shard: int, name: str, path: Path, apart_from: str) -> ReplicaHandle:
        """Start a replica on a file, on another machine than the named one if possible. Raises GaussLiteError."""
        ...

    def find(self, name: str) -> ReplicaHandle:
        """Return a replica by its name. Raises UnavailableError if none runs."""
        ...

    def stop(self, name: str) -> None:
        """End a replica at once, if it runs."""
        ...


@dataclass(frozen=True, slots=True)
class ShardState:
    """Primary and standby of a shard: names of replicas, which are also the names of their files; empty for none.

    joining: a standby that is being attached. It has not every write yet and cannot become the primary.
    """

    epoch: int = 0
    primary: str = ""
    standby: str = ""
    joining: str = ""
    replicas: int = 0


@dataclass(frozen=True, slots=True)
class Primary:
    """The replica that leads a shard in this epoch."""

    epoch: int
    name: str


class ShardDirectory:
    """Owns the state of all shards, in a file. One directory serves a store. Thread-safe.

    A failed primary is replaced by its standby, which has every acknowledged write. Without one, a new replica opens
    the primary's file. Each replacement begins a new epoch, written to the file before it begins.
    """

    def __init__(self, folder: Path, shards: int, hosts: ReplicaHosts) -> None:
        """Read or begin the state. Raises InvalidInputError for another number of shards, StorageError."""
        self._folder, self._hosts = folder, hosts
        # a standby that was being attached has not every write, and nobody attaches it any more
        self._shards = [replace(state, joining="") for state in read_states(folder, shards)]
        self._lock = Lock()
        self._shard_locks = [Lock() for _ in range(shards)]
        self._repairs = ThreadPoolExecutor(max_workers=2, thread_name_prefix="standby")

    def check(self) -> None:
        """Replace the primaries that do not lead, and start missing standbys. Raises StorageError."""
        failure: StorageError | None = None
        for shard, state in enumerate(self._shards):
            try:
                self.report_failure(shard, state.epoch)
            except StorageError as error:
                failure = error
            if not self._shards[shard].standby:
                self._repairs.submit(self._add_standby, shard)
        if failure is not None:
            raise failure

    def primary(self, shard: int) -> Primary:
        """Return the current primary."""
        state = self._shards[shard]
        return Primary(state.epoch, state.primary)

    def states(self) -> tuple[ShardState, ...]:
        """Return the state of every shard."""
        return tuple(self._shards)

    def report_failure(self, shard: int, epoch: int) -> Primary:
        """Check the primary of this epoch and replace it if it does not lead; returns the current one.

        Raises StorageError if no replica can be started.
        """
        with self._shard_locks[shard]:
            if self._shards[shard].epoch == epoch and not self._leads(self._shards[shard]):
                self._replace_primary(shard)
                self._repairs.submit(self._add_standby, shard)
        return self.primary(shard)

    def drop_standby(self, shard: int, epoch: int) -> bool:
        """Return whether the primary of this epoch may go on without its standby; a new standby is started."""
        # not the lock of the shard: its holder may wait for this primary
        with self._lock:
            state = self._shards[shard]
            if state.epoch != epoch:
                return False
            self._write(shard, replace(state, standby="", joining=""))
        _log.warning("shard %d: standby %s failed; a new one is started", shard, state.standby or state.joining)
        self._repairs.submit(self._add_standby, shard)
        return True

    def close(self) -> None:
        """Wait until no standby is being started."""
        self._repairs.shutdown(wait=True, cancel_futures=True)

    def _leads(self, state: ShardState) -> bool:
        if not state.primary:
            return False
        with contextlib.suppress(GaussLiteError):
            return self._hosts.find(state.primary).leads(state.epoch)
        return False

    def _replace_primary(self, shard: int) -> None:
        state = self._shards[shard]
        candidates: list[tuple[str, Callable[[], ReplicaHandle]]] = []
        if state.standby:
            candidates.append((state.standby, lambda: self._hosts.find(state.standby)))
        if state.primary:
            candidates.append((state.primary, lambda: self._restart(shard, state.primary)))
        if state.standby:
            candidates.append((state.standby, lambda: self._restart(shard, state.standby)))
        if not candidates:
            name = _replica_name(shard, state.replicas)
            state = replace(state, replicas=state.replicas + 1)
            candidates.append((name, lambda: self._start(shard, name)))
        failure: GaussLiteError | None = None
        for number, (name, begin) in enumerate(candidates):
            epoch = state.epoch + 1 + number
            # the old standby may lack writes that the new primary accepts
            with self._lock:
                self._write(shard, replace(state, epoch=epoch, primary=name, standby="", joining=""))
            try:
                begin().lead(epoch)
            except GaussLiteError as error:
                failure = error
                continue
            if state.primary and state.primary != name:
                self._hosts.stop(state.primary)
            _log.info("shard %d: replica %s leads epoch %d", shard, name, epoch)
            return
        with self._lock:
            # the next attempt has the same choice
            self._write(shard, replace(state, epoch=epoch))
        raise StorageError(f"shard {shard}: no replica can lead: {failure}")

    def _restart(self, shard: int, name: str) -> ReplicaHandle:
        self._hosts.stop(name)
        return self._start(shard, name)

    def _start(self, shard: int, name: str, apart_from: str = "") -> ReplicaHandle:
        return self._hosts.start(shard, name, self._path(name), apart_from)

    def _add_standby(self, shard: int) -> None:
        """Give the shard a standby, unless it has one."""
        with self._lock:
            state = self._shards[shard]
            if state.standby or state.joining or not state.primary:
                return
            name = _replica_name(shard, state.replicas)
            joining = replace(state, replicas=state.replicas + 1, joining=name)
            self._write(shard, joining)
        try:
            primary = self._hosts.find(state.primary)
            primary.copy_to(self._path(name))
            self._start(shard, name, apart_from=state.primary)
            primary.attach(state.epoch, name)
        except Exception as error:
            # it must not stay marked as joining, whatever happened
            _log.warning("shard %d: no standby: %s", shard, error)
            with self._lock:
                if self._shards[shard] == joining:
                    self._write(shard, replace(joining, joining=""))
            self._discard(name)
            return
        with self._lock:
            if self._shards[shard] != joining:
                # the primary has changed, or has dropped this standby again
                return
            self._write(shard, replace(joining, joining="", standby=name))
        self._delete_unused(shard)

    def _discard(self, name: str) -> None:
        self._hosts.stop(name)
        remove_store(self._path(name))

    def _delete_unused(self, shard: int) -> None:
        """Delete the files of replicas that take no part any more."""
        with self._lock:
            # the names first: a standby that begins to join later is not among them
            names = [path.stem for path in self._folder.glob(f"{_replica_prefix(shard)}*.sqlite")]
            state = self._shards[shard]
        for name in names:
            if name not in (state.primary, state.standby, state.joining):
                self._discard(name)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.sqlite"

    def _write(self, shard: int, state: ShardState) -> None:
        """Change the state of a shard, first in the file. Raises StorageError."""
        shards = [*self._shards[:shard], state, *self._shards[shard + 1 :]]
        _write_durably(self._folder / _FILE, json.dumps([asdict(each) for each in shards], indent=1))
        self._shards = shards


def read_states(folder: Path, shards: int) -> list[ShardState]:
    """Return the stored state of each shard, new ones in a new folder. Raises InvalidInputError, StorageError."""
    states = _read(folder / _FILE) or [ShardState()] * shards
    if len(states) != shards:
        raise InvalidInputError(f"store {folder}: expected its {len(states)} shards, got {shards}")
    return states


def _replica_prefix(shard: int) -> str:
    return f"shard-{shard}-replica-"


def _replica_name(shard: int, number: int) -> str:
    return f"{_replica_prefix(shard)}{number}"


def _read(path: Path) -> list[ShardState]:
    if not path.exists():
        return []
    try:
        content: list[dict[str, Any]] = json.loads(path.read_text())
        return [ShardState(**each) for each in content]
    except (OSError, ValueError, TypeError) as error:
        raise StorageError(f"store {path}: expected the directory of a sharded store ({error})") from error


def _write_durably(path: Path, text: str) -> None:
    new = path.with_suffix(".new")
    try:
        with new.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise StorageError(f"store {path}: cannot be written ({error.strerror})") from error
