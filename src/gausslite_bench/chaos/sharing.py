"""Run agents and servers that share a mission through seeded faults; compare the database with the acknowledgements."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from threading import RLock

from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.ply import ply_bytes
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.store_rows import UpdateLog, read_batches, require_intact
from gausslite.fusion.store_values import Scores
from gausslite.wire.clients import Export, FusionClient
from gausslite_bench.chaos.acknowledged import (
    AgentAcknowledgements,
    StoreComparison,
    compare_opened,
    offline_map,
)
from gausslite_bench.chaos.agent_team import AgentTeam
from gausslite_bench.chaos.fault_proxy import FaultProxy
from gausslite_bench.server.server_process import DEFAULT_COMMAND, ServerProcess
from gausslite_bench.server.sharing import new_database
from gausslite_cluster.regions import slots_of

_PROGRESS_S, _POLL_S, _MAX_FAULT_S = 240.0, 0.02, 2.0
_STARTS = 10
_SELECT_UPDATES = "SELECT number, agent_id, checksum, voxels FROM gausslite.voxel_updates ORDER BY slot, number"
_END_SERVERS = """
SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()
"""


class SharingFault(StrEnum):
    """What is counted."""

    SERVER_KILL = "server kills"
    AGENT_KILL = "agent kills"
    DATABASE_LOST = "lost connections to the database"
    PARTITION = "partitions between servers"
    STALL = "stalled servers"


_WEIGHTS = {
    SharingFault.SERVER_KILL: 4,
    SharingFault.AGENT_KILL: 1,
    SharingFault.DATABASE_LOST: 2,
    SharingFault.PARTITION: 2,
    SharingFault.STALL: 1,
}


@dataclass(frozen=True, slots=True)
class SharingChaosSettings:
    """store: the address of a database, beside which one is made. faults: number of kills and partitions."""

    store: str
    servers: int
    faults: int
    agents: int
    seed: int


@dataclass(frozen=True, slots=True)
class SharingChaosResult:
    """Figures of a run, as in ChaosResult.

    failovers_s: from each kill of a server until every agent of the other servers has a new answer.
    """

    faults: dict[str, int]
    acknowledged_messages: int
    comparisons: int
    voxels: int
    lost: int
    wrong: int
    extra_at_end: int
    same_map: bool
    server_errors: int
    failovers_s: tuple[float, ...]
    time_s: float

    @property
    def is_correct(self) -> bool:
        """True if nothing that was acknowledged is lost or differs."""
        return self.same_map and not (self.lost or self.wrong or self.extra_at_end or self.server_errors)


def run_sharing_chaos(settings: SharingChaosSettings, on_fault: Callable[[], object]) -> SharingChaosResult:
    """Run the faults; `on_fault` is called after each. Raises UnavailableError."""
    with new_database(settings.store) as url, tempfile.TemporaryDirectory() as name, ExitStack() as opened:
        places = [Path(name) / str(number) for number in range(settings.servers)]
        agents = [f"agent-{number}" for number in range(settings.agents)]
        targets = {place.name: place / "fusion.sock" for place in places}
        targets |= {agent: places[number % len(places)] / "fusion.sock" for number, agent in enumerate(agents)}
        proxy = FaultProxy(Path(name), targets)
        opened.callback(proxy.close)
        servers = {}
        for place in places:
            place.mkdir()
            servers[place.name] = ServerProcess(DEFAULT_COMMAND, place, url, peer=proxy.address(place.name))
            opened.callback(servers[place.name].kill)
        team = AgentTeam(Path(name), agents, proxy.address)
        opened.callback(team.close)
        return _SharingRun(settings, url, servers, proxy, team).run(on_fault)


@dataclass(slots=True)
class _SharingRun:
    """Runs the faults of one seed and counts them."""

    settings: SharingChaosSettings
    url: str
    servers: Mapping[str, ServerProcess]
    proxy: FaultProxy
    team: AgentTeam
    faults: Counter[SharingFault] = field(default_factory=Counter)
    comparisons: list[StoreComparison] = field(default_factory=list)
    failovers_s: list[float] = field(default_factory=list)
    _random: random.Random = field(init=False)

    def run(self, on_fault: Callable[[], object]) -> SharingChaosResult:
        begin_s = time.monotonic()
        self._random = random.Random(self.settings.seed)  # noqa: S311 - reproducible faults
        for agent_id in self.team.acknowledged:
            self.team.start(agent_id, self._random.getrandbits(31), 0.0)
        for _ in range(self.settings.faults):
            self._wait_for_progress()
            self._inject(self._random.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0])
            on_fault()
        return self._finish(begin_s)

    def _inject(self, fault: SharingFault) -> None:
        self.faults[fault] += 1
        name = self._random.choice(list(self.servers))
        match fault:
            case SharingFault.SERVER_KILL:
                self.servers[name].kill()
                self._compare()
                self.failovers_s.append(self._wait_for_progress(without=name))
                self._start(self.servers[name])
            case SharingFault.AGENT_KILL:
                agent_id = self._random.choice(list(self.team.acknowledged))
                self.team.kill(agent_id)
                self.team.start(agent_id, self._random.getrandbits(31), 0.0)
            case SharingFault.DATABASE_LOST:
                _end_connections(self.url)
            case SharingFault.PARTITION | SharingFault.STALL:
                (self.proxy.cut if fault is SharingFault.PARTITION else self.proxy.stall)(name)
                threading.Event().wait(self._random.uniform(0.1, _MAX_FAULT_S))
                self.proxy.clear_faults(name)

    def _compare(self) -> None:
        # what has been acknowledged by now must be in the database
        self.team.read()
        self.comparisons.append(_compare_database(self.team.acknowledged, self.url))

    def _start(self, server: ServerProcess) -> None:
        for attempt in range(_STARTS):
            try:
                server.start()
            except UnavailableError:
                # the database may still have the connection of the killed process
                if attempt == _STARTS - 1:
                    raise
            else:
                return

    def _wait_for_progress(self, without: str = "") -> float:
        """Return the time until every agent has a new answer, but those of one server. Raises UnavailableError."""
        self.team.read()
        names = list(self.servers)
        agents = [
            own for number, own in enumerate(self.team.acknowledged.values()) if names[number % len(names)] != without
        ]
        before, begin_s = [own.messages for own in agents], time.monotonic()
        while any(own.messages == count for own, count in zip(agents, before, strict=True)):
            if time.monotonic() > begin_s + _PROGRESS_S:
                raise UnavailableError(f"chaos: expected acknowledgements within {_PROGRESS_S:.0f} s after a fault")
            threading.Event().wait(_POLL_S)
            self.team.read()
        return time.monotonic() - begin_s

    def _export(self) -> bytes:
        """Return the fused map, also if regions still move after the last fault. Raises UnavailableError."""
        end_s = time.monotonic() + _PROGRESS_S
        with FusionClient(next(iter(self.servers.values())).address, deadline_s=60.0) as client:
            while True:
                try:
                    return client.export(Export())
                except UnavailableError:
                    if time.monotonic() > end_s:
                        raise
                    threading.Event().wait(_POLL_S)

    def _finish(self, begin_s: float) -> SharingChaosResult:
        self.team.finish()
        offline = offline_map(self.team.acknowledged)
        exported = self._export()
        self._compare()
        logs = [server.log.read_text(errors="replace") for server in self.servers.values()]
        last = self.comparisons[-1]
        return SharingChaosResult(
            faults={str(fault): self.faults[fault] for fault in SharingFault},
            acknowledged_messages=sum(own.messages for own in self.team.acknowledged.values()),
            comparisons=len(self.comparisons),
            voxels=last.voxels,
            lost=sum(comparison.lost for comparison in self.comparisons),
            wrong=sum(comparison.wrong for comparison in self.comparisons),
            extra_at_end=last.extra,
            same_map=exported == ply_bytes(offline.gaussians),
            server_errors=sum(log.count("Traceback") for log in logs),
            failovers_s=tuple(self.failovers_s),
            time_s=time.monotonic() - begin_s,
        )


class _Snapshot:
    """The updates of a database at one instant, while servers write."""

    def __init__(self, url: str) -> None:
        # an extra
        import psycopg

        self._log, self._lock = UpdateLog(slots_of), RLock()
        with psycopg.connect(url) as db:
            rows = db.execute(_SELECT_UPDATES, binary=True).fetchall()
        self._log.load(require_intact(rows, StorageError))
        self._data = {row[0]: row[3] for row in rows}

    def batch(self, agent_id: str) -> VoxelBatch:
        """Return an agent's updates."""
        return read_batches(self._log, self._lock, self._read, None, (agent_id,))[agent_id]

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the agent's totals on these voxels."""
        return self._log.index.stored(agent_id, keys)

    def _read(self, numbers: Sequence[int]) -> dict[int, bytes]:
        return {number: self._data[number] for number in numbers}


def _compare_database(agents: Mapping[str, AgentAcknowledgements], url: str) -> StoreComparison:
    return compare_opened(agents, _Snapshot(url))


def _end_connections(url: str) -> None:
    import psycopg

    with psycopg.connect(url, autocommit=True) as db:
        db.execute(_END_SERVERS)
