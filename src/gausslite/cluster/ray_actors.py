"""The actors of Ray that run the replicas and the directory of a sharded store, and the handles to them."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# before Ray is imported: it sends usage statistics otherwise
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

import ray
from ray.exceptions import GetTimeoutError, RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from gausslite.cluster.leadership import Leadership
from gausslite.cluster.replica import ShardReplica
from gausslite.cluster.shard_directory import Primary, ShardDirectory, ShardState
from gausslite.cluster.store_calls import LogEntry, LogPosition, StoreCall, StoreReply
from gausslite.domain.errors import GaussLiteError, UnavailableError

_DIRECTORY = "directory"
_CALL_LIMIT_S = 30.0
_START_LIMIT_S = 300.0
_PING_LIMIT_S = 5.0
_CHECK_PERIOD_S = 5.0
_THREADS = 16


@dataclass(frozen=True, slots=True)
class _Replica:
    """A ReplicaHandle and Standby over an actor."""

    actor: Any

    def lead(self, epoch: int) -> LogPosition:
        position: LogPosition = _result(self.actor.lead.remote(epoch), _CALL_LIMIT_S)
        return position

    def leads(self, epoch: int) -> bool:
        return bool(_result(self.actor.leads.remote(epoch), _PING_LIMIT_S))

    def copy_to(self, path: Path) -> None:
        _result(self.actor.copy_to.remote(path), _START_LIMIT_S)

    def attach(self, epoch: int, standby: str) -> LogPosition:
        position: LogPosition = _result(self.actor.attach.remote(epoch, standby), _START_LIMIT_S)
        return position

    def follow(self, epoch: int) -> LogPosition:
        position: LogPosition = _result(self.actor.follow.remote(epoch), _CALL_LIMIT_S)
        return position

    def append(self, entry: LogEntry) -> None:
        _result(self.actor.append.remote(entry), _CALL_LIMIT_S)

    def call(self, epoch: int, call: StoreCall) -> StoreReply:
        reply: StoreReply = _result(self.actor.call.remote(epoch, call), _CALL_LIMIT_S)
        return reply


@dataclass(frozen=True, slots=True)
class DirectoryProxy:
    """A Directory over its actor."""

    actor: Any

    def primary(self, shard: int) -> Primary:
        """Return the current primary."""
        primary: Primary = _result(self.actor.primary.remote(shard), _CALL_LIMIT_S)
        return primary

    def report_failure(self, shard: int, epoch: int) -> Primary:
        """Return the current primary, after a check of this epoch's."""
        primary: Primary = _result(self.actor.report_failure.remote(shard, epoch), _START_LIMIT_S)
        return primary

    def drop_standby(self, shard: int, epoch: int) -> bool:
        """Return whether the primary of this epoch may go on without its standby."""
        return bool(_result(self.actor.drop_standby.remote(shard, epoch), _CALL_LIMIT_S))

    def states(self) -> tuple[ShardState, ...]:
        """Return the state of every shard."""
        states: tuple[ShardState, ...] = _result(self.actor.states.remote(), _CALL_LIMIT_S)
        return states

    def lead(self, server_id: str) -> bool:
        """Return whether this server leads, see Leadership.ask. Raises UnavailableError."""
        return bool(_result(self.actor.lead.remote(server_id), _CALL_LIMIT_S))

    def close(self) -> None:
        """Wait until no standby is being started."""
        with contextlib.suppress(GaussLiteError):
            _result(self.actor.close.remote(), _CALL_LIMIT_S)


class _ReplicaActor:
    """The process of a ShardReplica."""

    def __init__(self, shard: int, path: Path, max_bytes: int | None) -> None:
        self._shard = shard
        self._replica = ShardReplica(path, max_bytes)

    def lead(self, epoch: int) -> LogPosition:
        return self._replica.lead(epoch, self._may_drop_standby)

    def leads(self, epoch: int) -> bool:
        return self._replica.leads(epoch)

    def copy_to(self, path: Path) -> None:
        self._replica.copy_to(path)

    def attach(self, epoch: int, standby: str) -> LogPosition:
        return self._replica.attach(epoch, _find_replica(standby))

    def follow(self, epoch: int) -> LogPosition:
        return self._replica.follow(epoch)

    def append(self, entry: LogEntry) -> None:
        self._replica.append(entry)

    def call(self, epoch: int, call: StoreCall) -> StoreReply:
        return self._replica.call(epoch, call)

    def node_id(self) -> str:
        return str(ray.get_runtime_context().get_node_id())

    def _may_drop_standby(self, epoch: int) -> bool:
        with contextlib.suppress(GaussLiteError):
            return DirectoryProxy(_find_actor(_DIRECTORY)).drop_standby(self._shard, epoch)
        return False


class _DirectoryActor:
    """The process of the ShardDirectory; it checks all replicas every few seconds."""

    def __init__(self, folder: Path, shards: int, max_bytes: int | None) -> None:
        self._directory = ShardDirectory(folder, shards, _RayHosts(max_bytes))
        self._leadership = Leadership()
        self._closing = threading.Event()
        threading.Thread(target=self._check_regularly, name="check", daemon=True).start()

    def check(self) -> None:
        self._directory.check()

    def primary(self, shard: int) -> Primary:
        return self._directory.primary(shard)

    def report_failure(self, shard: int, epoch: int) -> Primary:
        return self._directory.report_failure(shard, epoch)

    def drop_standby(self, shard: int, epoch: int) -> bool:
        return self._directory.drop_standby(shard, epoch)

    def states(self) -> tuple[ShardState, ...]:
        return self._directory.states()

    def lead(self, server_id: str) -> bool:
        return self._leadership.ask(server_id)

    def close(self) -> None:
        self._closing.set()
        self._directory.close()

    def _check_regularly(self) -> None:
        while not self._closing.wait(_CHECK_PERIOD_S):
            try:
                self._directory.check()
            except GaussLiteError as error:
                logging.getLogger(__name__).warning("shards: %s", error)


@dataclass(frozen=True, slots=True)
class _RayHosts:
    """ReplicaHosts over the nodes of the cluster."""

    max_bytes: int | None

    def start(self, shard: int, name: str, path: Path, apart_from: str) -> _Replica:
        options: dict[str, Any] = {"name": name, "lifetime": "detached", "max_concurrency": _THREADS, "num_cpus": 0}
        options["scheduling_strategy"] = _placement(shard, apart_from)
        with ray_errors():
            try:
                actor: Any = ray.remote(_ReplicaActor).options(**options).remote(shard, path, self.max_bytes)
            except ValueError as error:
                raise UnavailableError(f"ray: the actor {name!r} that was stopped has not ended yet") from error
        _result(actor.node_id.remote(), _START_LIMIT_S)
        return _Replica(actor)

    def find(self, name: str) -> _Replica:
        return _find_replica(name)

    def stop(self, name: str) -> None:
        with contextlib.suppress(GaussLiteError):
            actor = _find_actor(name)
            ray.kill(actor)


def connect(address: str, namespace: str, object_bytes: int | None) -> None:
    """Connect to a cluster; object_bytes: start one on this machine, with this much shared memory for objects.

    Raises UnavailableError.
    """
    options: dict[str, Any] = {"namespace": namespace, "log_to_driver": False, "configure_logging": False}
    if object_bytes is not None:
        options |= {"include_dashboard": False, "object_store_memory": object_bytes}
    _require_reachable(address)
    with ray_errors():
        try:
            ray.init(address=address, **options)
        except (ConnectionError, ValueError) as error:
            raise UnavailableError(f"ray: expected a cluster at {address!r}, got none ({error})") from error


def _require_reachable(address: str) -> None:
    """Raise UnavailableError if nothing listens at HOST:PORT; Ray would try for minutes and end the process."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit():
        try:
            socket.create_connection((host, int(port)), _PING_LIMIT_S).close()
        except OSError as error:
            raise UnavailableError(f"ray: expected a cluster at {address!r}, got none ({error})") from error


def disconnect() -> None:
    """End the connection, and a cluster that `connect` has started."""
    ray.shutdown()


def open_directory(folder: Path, shards: int, max_bytes: int | None) -> DirectoryProxy:
    """Return the directory of a store; it is started if it does not run. Raises StorageError, UnavailableError."""
    options: dict[str, Any] = {"lifetime": "detached", "max_concurrency": _THREADS, "num_cpus": 0, "max_restarts": -1}
    with ray_errors():
        actor: Any = (
            ray.remote(_DirectoryActor)
            .options(name=_DIRECTORY, get_if_exists=True, **options)
            .remote(folder, shards, max_bytes)
        )
    _result(actor.check.remote(), _START_LIMIT_S)
    return DirectoryProxy(actor)


def call_replica(name: str, epoch: int, call: StoreCall) -> StoreReply:
    """Run a call on a replica, see remote_store.CallReplica."""
    return _find_replica(name).call(epoch, call)


def _find_replica(name: str) -> _Replica:
    return _Replica(_find_actor(name))


def _find_actor(name: str) -> Any:
    with ray_errors():
        try:
            return ray.get_actor(name)
        except ValueError as error:
            raise UnavailableError(f"ray: no actor {name!r}") from error


def _placement(shard: int, apart_from: str) -> NodeAffinitySchedulingStrategy:
    """Return the node of a new replica: the primaries take turns over the nodes, a standby gets another node.

    Ray's own strategy SPREAD does not keep actors without CPU demand apart.
    """
    nodes = sorted(node["NodeID"] for node in _nodes() if node["Alive"])
    if apart_from:
        used = _result(_find_actor(apart_from).node_id.remote(), _CALL_LIMIT_S)
        nodes = [node for node in nodes if node != used] or nodes
    # Ray does not keep to a soft affinity if the actor has no CPU demand. If the node has just died, the start fails
    # and the next check of the directory tries again
    return NodeAffinitySchedulingStrategy(nodes[shard % len(nodes)], soft=False)


def _nodes() -> list[dict[str, Any]]:
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return nodes


def _result(reference: Any, limit_s: float) -> Any:
    """Wait for the result of an actor's method. Raises UnavailableError, and what the method raises."""
    with ray_errors():
        return ray.get(reference, timeout=limit_s)


@contextlib.contextmanager
def ray_errors() -> Iterator[None]:
    """Convert Ray's errors; those of GaussLite get out as they were raised in the actor."""
    try:
        yield
    except RayTaskError as error:
        if isinstance(error.cause, GaussLiteError):
            raise error.cause from None
        raise UnavailableError(f"ray: unexpected error in an actor: {error.cause!r}") from error
    except (GetTimeoutError, RayError) as error:
        raise UnavailableError(f"ray: an actor cannot be reached ({type(error).__name__})") from error
