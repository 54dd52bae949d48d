"""Replicas of a sharded store in this process: real files, a real directory, and failures on request."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gausslite.cluster.remote_store import RemoteStore
from gausslite.cluster.replica import ShardReplica
from gausslite.cluster.shard_directory import ShardDirectory
from gausslite.cluster.sharded_store import ShardedStore
from gausslite.cluster.store_calls import LogEntry, LogPosition, StoreCall, StoreReply
from gausslite.domain.errors import UnavailableError


@dataclass
class LocalHosts:
    """ReplicaHosts that run replicas as objects. An unreachable replica runs on, and nobody can call it."""

    folder: Path
    running: dict[str, ShardReplica] = field(default_factory=dict)
    unreachable: set[str] = field(default_factory=set)
    fails_to_start: bool = False
    directory: ShardDirectory | None = None

    def start(self, shard: int, name: str, path: Path, apart_from: str) -> LocalReplica:
        del apart_from
        if self.fails_to_start:
            raise UnavailableError("no machine")
        self.running[name] = ShardReplica(path)
        return LocalReplica(self, shard, name)

    def find(self, name: str) -> LocalReplica:
        self.replica(name)
        return LocalReplica(self, int(name.split("-")[1]), name)

    def stop(self, name: str) -> None:
        if name in self.running and name not in self.unreachable:
            self.running.pop(name).close()

    def replica(self, name: str) -> ShardReplica:
        if name not in self.running or name in self.unreachable:
            raise UnavailableError(f"{name} cannot be reached")
        return self.running[name]

    def call(self, name: str, epoch: int, call: StoreCall) -> StoreReply:
        return self.replica(name).call(epoch, call)

    def open_store(self, shards: int) -> ShardedStore:
        """Start a directory on the folder, and return a store of it."""
        self.directory = ShardDirectory(self.folder, shards, self)
        self.directory.check()
        return self.share_store(shards)

    def share_store(self, shards: int) -> ShardedStore:
        """Return the store of another server on the same replicas."""
        assert self.directory is not None
        return ShardedStore([RemoteStore(shard, self.directory, self.call) for shard in range(shards)])

    def close(self) -> None:
        if self.directory is not None:
            self.directory.close()
        self.unreachable.clear()
        for name in list(self.running):
            self.stop(name)


@dataclass(frozen=True)
class LocalReplica:
    """A ReplicaHandle and Standby."""

    hosts: LocalHosts
    shard: int
    name: str

    def lead(self, epoch: int) -> LogPosition:
        return self.hosts.replica(self.name).lead(epoch, self._may_drop_standby)

    def leads(self, epoch: int) -> bool:
        return self.hosts.replica(self.name).leads(epoch)

    def copy_to(self, path: Path) -> None:
        self.hosts.replica(self.name).copy_to(path)

    def attach(self, epoch: int, standby: str) -> LogPosition:
        return self.hosts.replica(self.name).attach(epoch, self.hosts.find(standby))

    def follow(self, epoch: int) -> LogPosition:
        return self.hosts.replica(self.name).follow(epoch)

    def append(self, entry: LogEntry) -> None:
        self.hosts.replica(self.name).append(entry)

    def _may_drop_standby(self, epoch: int) -> bool:
        assert self.hosts.directory is not None
        return self.hosts.directory.drop_standby(self.shard, epoch)
