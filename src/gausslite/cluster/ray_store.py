"""The store of a fusion server on Ray: connect to a cluster, or start one on this machine."""

from __future__ import annotations

import hashlib
import secrets
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from gausslite.cluster.leadership import LEADERSHIP_S
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

    Any number of servers can use a folder in one cluster. A local Ray belongs to one server.
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
        self._server_id, self._leads_until_s = secrets.token_hex(16), -float("inf")
        with ExitStack() as opened:
            if self._is_local:
                opened.callback(StoreLock(self._folder / "server").release)
            self._open(settings)
            self._opened = opened.pop_all()

    def leads(self) -> bool:
        """Return whether this server has the leadership."""
        return time.monotonic() < self._leads_until_s

    def renew(self) -> None:
        """Ask for the leadership, or for more time of it. Raises UnavailableError."""
        asked_s = time.monotonic()
        if self._directory.lead(self._server_id):
            self._leads_until_s = asked_s + LEADERSHIP_S

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
        self._opened.close()

    def _open(self, settings: RaySettings) -> None:
        # the actors of two stores in one cluster have the same names
        namespace = "gausslite-" + hashlib.sha256(str(self._folder).encode()).hexdigest()[:16]
        connect(settings.address, namespace, _LOCAL_OBJECT_BYTES if self._is_local else None)
        self._directory = open_directory(self._folder, settings.shards, settings.max_bytes)
        self._clients = [RemoteStore(shard, self._directory, call_replica) for shard in range(settings.shards)]
        super().__init__(self._clients)
