"""The store of a fusion server on Ray: connect to a cluster, or start one on this machine."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from gausslite.cluster.ray_actors import call_replica, connect, disconnect, open_directory
from gausslite.cluster.remote_store import RemoteStore
from gausslite.cluster.shard_directory import ShardState, read_states
from gausslite.cluster.sharded_store import ShardedStore
from gausslite.cluster.store_calls import LogPosition
from gausslite.domain.errors import StorageError
from gausslite.fusion.sqlite_file import StoreLock

_LOCAL_OBJECT_BYTES = 512 << 20
LOCAL = "local"
"""Address that starts Ray on this machine, for this process."""


@dataclass(frozen=True, slots=True)
class RaySettings:
    """folder: on storage that every machine shares. address: of a Ray cluster, or LOCAL."""

    folder: Path
    shards: int = 2
    address: str = LOCAL
    max_bytes: int | None = None


class RayStore(ShardedStore):
    """A sharded store whose shards are actors. A local Ray ends with it; actors in a cluster go on.

    One process at a time can use a folder.
    """

    def __init__(self, settings: RaySettings) -> None:
        """Connect, and start the actors that do not run.

        Raises InvalidInputError for another number of shards, StorageError, UnavailableError.
        """
        self._folder, self._is_local = settings.folder.resolve(), settings.address == LOCAL
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"store {self._folder}: cannot be made ({error.strerror})") from error
        read_states(self._folder, settings.shards)
        self._lock_of_server = StoreLock(self._folder / "server")
        try:
            self._open(settings)
        except BaseException:
            self._lock_of_server.release()
            raise

    def positions(self) -> tuple[LogPosition, ...]:
        """Return the position of each shard after its latest acknowledged call."""
        return tuple(client.position for client in self._clients)

    def states(self) -> tuple[ShardState, ...]:
        """Return the replicas of each shard. Raises UnavailableError."""
        return self._directory.states()

    def close(self) -> None:
        """Disconnect; a local Ray is stopped."""
        super().close()
        if self._is_local:
            self._directory.close()
        disconnect()
        self._lock_of_server.release()

    def _open(self, settings: RaySettings) -> None:
        # the actors of two stores in one cluster have the same names
        namespace = "gausslite-" + hashlib.sha256(str(self._folder).encode()).hexdigest()[:16]
        connect(settings.address, namespace, _LOCAL_OBJECT_BYTES if self._is_local else None)
        self._directory = open_directory(self._folder, settings.shards, settings.max_bytes)
        self._clients = [RemoteStore(shard, self._directory, call_replica) for shard in range(settings.shards)]
        super().__init__(self._clients)
