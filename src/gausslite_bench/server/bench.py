"""Measure a fusion server: agents at 4 Hz, snapshot, status, restart and memory, by the Gaussians that it holds."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from gausslite.domain.errors import GaussLiteError
from gausslite.wire.clients import FusionClient
from gausslite_bench.server.agent_load import AgentLoad, LoadResult
from gausslite_bench.server.server_process import ServerProcess
from gausslite_bench.server.synthetic_updates import GAUSSIANS_PER_VOXEL

P99_LIMIT_MS = 100.0
_STATUS_CALLS = 5
_WATCH_PAUSE_S = 2.0


@dataclass(frozen=True, slots=True)
class ServerBenchSettings:
    """What to measure; command: starts the server. watchers: number that stop reading after the first block."""

    held: Sequence[int]
    agents: Sequence[int]
    seconds: float
    command: str
    store: str
    watchers: int


@dataclass(frozen=True, slots=True)
class StoredSizeResult:
    """The figures of a server that holds this many Gaussians."""

    held: int
    loads: tuple[LoadResult, ...]
    fill_s: float
    snapshot_s: float
    status_ms: float
    restart_s: float
    rss_mib: float
    watchers_mib: float

    @property
    def largest_team(self) -> int:
        """The largest number of agents before the first with a p99 over the limit or a missing acknowledgement."""
        largest = 0
        for load in self.loads:
            if load.p99_ms > P99_LIMIT_MS or load.missing:
                break
            largest = load.agents
        return largest


def measure(settings: ServerBenchSettings, held: int, on_progress: Callable[[str], None]) -> StoredSizeResult:
    """Fill a new server and measure it. `on_progress` receives a description of each step."""
    with tempfile.TemporaryDirectory() as folder:
        server = ServerProcess(settings.command, Path(folder), settings.store)
        with closing(server):
            return _measure(settings, held, server, on_progress)


def _measure(
    settings: ServerBenchSettings, held: int, server: ServerProcess, on_progress: Callable[[str], None]
) -> StoredSizeResult:
    load = AgentLoad(server.address)
    on_progress(f"{held} Gaussians: fill")
    begin_s = time.monotonic()
    load.fill(held, GAUSSIANS_PER_VOXEL)
    fill_s = time.monotonic() - begin_s
    loads: list[LoadResult] = []
    for agents in settings.agents:
        on_progress(f"{held} Gaussians: {agents} agents")
        cpu_s = server.cpu_s()
        result = load.run(agents, settings.seconds)
        loads.append(replace(result, server_cpu_ms=1000 * (server.cpu_s() - cpu_s) / result.messages))
    on_progress(f"{held} Gaussians: snapshot, status, restart")
    snapshot_s, status_ms = _snapshot_s(server.address), _status_ms(server.address)
    rss_mib = server.rss_mib()
    watchers_mib = _idle_watchers_mib(server, settings.watchers)
    restart_s = server.restart()
    return StoredSizeResult(
        held=held,
        loads=tuple(loads),
        fill_s=fill_s,
        snapshot_s=snapshot_s,
        status_ms=status_ms,
        restart_s=restart_s,
        rss_mib=rss_mib,
        watchers_mib=watchers_mib,
    )


def _snapshot_s(address: str) -> float:
    """Return the time until a new watcher has the whole map."""
    with FusionClient(address, deadline_s=600.0) as client:
        begin_s = time.monotonic()
        watch = client.watch()
        while not next(watch).last:
            pass
        return time.monotonic() - begin_s


def _status_ms(address: str) -> float:
    with FusionClient(address, deadline_s=600.0) as client:
        client.status()
        times_s = []
        for _ in range(_STATUS_CALLS):
            begin_s = time.monotonic()
            client.status()
            times_s.append(time.monotonic() - begin_s)
        return 1000 * median(times_s)


def _idle_watchers_mib(server: ServerProcess, watchers: int) -> float:
    """Return how much memory of the server watchers take that stop reading after the first block."""
    if not watchers:
        return 0.0
    before_mib = server.rss_mib()
    clients = [FusionClient(server.address, deadline_s=600.0) for _ in range(watchers)]
    try:
        streams = [client.watch() for client in clients]
        for stream in streams:
            next(stream)
        threading.Event().wait(_WATCH_PAUSE_S)
        return server.rss_mib() - before_mib
    except GaussLiteError:
        return float("nan")
    finally:
        for client in clients:
            client.close()
