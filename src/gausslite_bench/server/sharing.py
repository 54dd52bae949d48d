"""Measure servers that share a mission in a PostgreSQL database: the work of all for a message, and a killed one."""

from __future__ import annotations

import itertools
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from gausslite_bench.server.agent_load import AgentLoad
from gausslite_bench.server.bench import ServerBenchSettings
from gausslite_bench.server.server_process import ServerProcess, process_cpu_s
from gausslite_bench.server.synthetic_updates import GAUSSIANS_PER_VOXEL

_numbers = itertools.count()
_WARM_UP_S = 3.0


@dataclass(frozen=True, slots=True)
class SharingResult:
    """The figures of a number of servers; those of the processes are sums over all servers, per message.

    received, stored: messages from agents, and parts of messages stored, of each server. failover_s: the longest time
    to an acknowledgement while one server is killed, at the others; None with one server.
    """

    servers: int
    agents: int
    held: int
    p50_ms: float
    p99_ms: float
    missing: int
    server_cpu_ms: float
    database_cpu_ms: float
    received: tuple[int, ...]
    stored: tuple[int, ...]
    foreign: int
    failover_s: float | None


@contextmanager
def new_database(url: str) -> Iterator[str]:
    """Create a database beside the one of this address, and delete it at the end; gives its address."""
    # an extra
    import psycopg

    name = f"gausslite_bench_{os.getpid()}_{next(_numbers)}"
    with psycopg.connect(url, autocommit=True) as db:
        db.execute(f"CREATE DATABASE {name}".encode())
        try:
            yield urlsplit(url)._replace(path=f"/{name}").geturl()
        finally:
            db.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())


def measure_sharing(settings: ServerBenchSettings, servers: int, on_progress: Callable[[str], None]) -> SharingResult:
    """Start the servers on a new database, fill it and measure them, with the first numbers of the settings."""
    held, agents, seconds = settings.held[0], settings.agents[0], settings.seconds
    with new_database(settings.store) as own, tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        running: list[ServerProcess] = []
        for number in range(servers):
            place = Path(folder) / str(number)
            place.mkdir()
            on_progress(f"{servers} servers: start")
            running.append(stack.enter_context(closing(ServerProcess(settings.command, place, own, shares=True))))
        load = AgentLoad(*(server.address for server in running))
        on_progress(f"{servers} servers: fill with {held} Gaussians")
        load.fill(held, GAUSSIANS_PER_VOXEL)
        on_progress(f"{servers} servers: {agents} agents")
        # what a server does once is not the cost of a message
        load.run(agents, _WARM_UP_S)
        before, work_before = [server.counters() for server in running], _cpu_s(own, running)
        result = load.run(agents, seconds)
        work, after = _cpu_s(own, running), [server.counters() for server in running]
        received, stored, foreign = (
            tuple(new[name] - old[name] for new, old in zip(after, before, strict=True))
            for name in ("messages_received", "parts_stored", "parts_foreign")
        )
        failover_s = None
        if servers > 1:
            on_progress(f"{servers} servers: one is killed")
            failover_s = _failover_s(load, running, agents, seconds)
    return SharingResult(
        servers=servers,
        agents=agents,
        held=held,
        p50_ms=result.p50_ms,
        p99_ms=result.p99_ms,
        missing=result.missing,
        server_cpu_ms=1000 * (work[0] - work_before[0]) / result.messages,
        database_cpu_ms=1000 * (work[1] - work_before[1]) / result.messages,
        received=received,
        stored=stored,
        foreign=sum(foreign),
        failover_s=failover_s,
    )


def _failover_s(load: AgentLoad, running: Sequence[ServerProcess], agents: int, seconds: float) -> float:
    *others, killed = running
    timer = threading.Timer(seconds / 2, killed.kill)
    timer.start()
    result = load.at(*(server.address for server in others)).run(agents, seconds)
    timer.join()
    return result.longest_ms / 1000 if not result.missing else float("inf")


def _cpu_s(url: str, running: Sequence[ServerProcess]) -> tuple[float, float]:
    """Return the processor time of all servers, and of the database's processes for them if it runs on this machine."""
    import psycopg

    query = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    with psycopg.connect(url) as db:
        pids = [pid for (pid,) in db.execute(query)]
    backends = [pid for pid in pids if Path(f"/proc/{pid}/stat").exists()]
    return sum(server.cpu_s() for server in running), sum(map(process_cpu_s, backends))
