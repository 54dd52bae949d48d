"""Run agents and a server through seeded faults, and compare what the server has with what it acknowledged."""

from __future__ import annotations

import asyncio
import random
import resource
import shlex
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from gausslite.codec.ply import ply_bytes
from gausslite.domain.errors import UnavailableError
from gausslite.wire.clients import Export, FusionClient
from gausslite_bench.async_calls import UpdateStreams
from gausslite_bench.chaos.acknowledged import StoreComparison, compare_store, offline_map
from gausslite_bench.chaos.agent_team import AgentTeam
from gausslite_bench.chaos.fault_proxy import FaultProxy
from gausslite_bench.chaos.map_watcher import MapWatcher
from gausslite_bench.server.server_process import ServerProcess

_STORE = "store.sqlite"
_DAY_S = 86_400.0
_PROGRESS_MESSAGES_PER_AGENT = 2
_PROGRESS_S = 120.0
_WATCH_S = 60.0
_POLL_S = 0.02
_MAX_FAULT_S, _MAX_FULL_S = 1.0, 5.0
_MAX_DELAY_S = 0.15
_RESENT_MESSAGES = 20
_RESEND_LIMIT_S = 10.0
_DISK_FULL_SHARE, _RESEND_SHARE, _CLOCK_SHARE = 0.15, 0.4, 0.5
_FREE_BYTES = 50_000


class Fault(StrEnum):
    """What is counted. The first five are the kills and partitions of a run."""

    SERVER_KILL = "server kills"
    AGENT_KILL = "agent kills"
    CUT = "cut connections"
    STALL = "stalled connections"
    DELAY = "delayed connections"
    CLOCK_JUMP = "clock jumps"
    DISK_FULL = "full disks"
    RESEND = "resent messages"


_WEIGHTS = {Fault.SERVER_KILL: 3, Fault.AGENT_KILL: 3, Fault.CUT: 2, Fault.STALL: 1, Fault.DELAY: 1}


@dataclass(frozen=True, slots=True)
class ChaosSettings:
    """kills: number of kills and partitions. out: folder that receives the store, journals and logs."""

    kills: int = 200
    agents: int = 4
    seed: int = 0
    out: Path | None = None


@dataclass(frozen=True, slots=True)
class ChaosResult:
    """Figures of a run.

    lost, wrong: sums over the comparisons of the store after each kill of the server, and after the run.
    same_map: the map that the server exports at the end is the offline one, bit for bit. same_watch: a watcher that
    continued from its last revision after each restart has the same voxels, Σkappa and counts at the end.
    disk_errors: lines in the server's log about a disk that refuses to write; server_errors: unexpected errors there.
    """

    faults: dict[str, int]
    acknowledged_messages: int
    acknowledged_updates: int
    disk_errors: int
    comparisons: int
    voxels: int
    fused_voxels: int
    lost: int
    wrong: int
    extra_at_end: int
    same_map: bool
    same_watch: bool
    server_errors: int
    time_s: float
    rss_mib: tuple[float, float]

    @property
    def is_correct(self) -> bool:
        """True if nothing that was acknowledged is lost or differs."""
        has_faults = self.lost or self.wrong or self.extra_at_end or self.server_errors
        return self.same_map and self.same_watch and not has_faults


def run_chaos(settings: ChaosSettings, on_fault: Callable[[], object]) -> ChaosResult:
    """Run the faults; `on_fault` is called after each kill or partition. Raises UnavailableError."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as opened:
        folder = Path(name)
        if settings.out is not None:
            opened.callback(shutil.copytree, folder, settings.out, dirs_exist_ok=True, ignore=_ignore_sockets)
        agents = [f"agent-{number}" for number in range(settings.agents)]
        server = ServerProcess(_server_command(0.0), folder, "sqlite")
        opened.callback(server.kill)
        proxy = FaultProxy(folder, dict.fromkeys(agents, Path(server.address.removeprefix("unix:"))))
        opened.callback(proxy.close)
        team = AgentTeam(folder, agents, proxy.address)
        opened.callback(team.close)
        watcher = MapWatcher(server.address)
        opened.callback(watcher.close)
        return _ChaosRun(settings, folder, server, proxy, team, watcher).run(on_fault)


@dataclass(slots=True)
class _ChaosRun:
    """Runs the faults of one seed and counts them."""

    settings: ChaosSettings
    folder: Path
    server: ServerProcess
    proxy: FaultProxy
    team: AgentTeam
    watcher: MapWatcher
    faults: Counter[Fault] = field(default_factory=Counter)
    comparisons: list[StoreComparison] = field(default_factory=list)
    _random: random.Random = field(init=False)
    _peak_mib: float = 0.0

    def run(self, on_fault: Callable[[], object]) -> ChaosResult:
        begin_s = time.monotonic()
        self._random = random.Random(self.settings.seed)  # noqa: S311 - reproducible faults
        for agent_id in self.team.acknowledged:
            self._start_agent(agent_id)
        for _ in range(self.settings.kills):
            self._wait_for_progress()
            if self._random.random() < _DISK_FULL_SHARE:
                self._fill_disk()
            if self._random.random() < _RESEND_SHARE:
                self._resend()
            self._inject(self._random.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0])
            on_fault()
        return self._finish(begin_s)

    def _inject(self, fault: Fault) -> None:
        self.faults[fault] += 1
        agent_id = self._random.choice(list(self.team.acknowledged))
        match fault:
            case Fault.SERVER_KILL:
                self._kill_server()
                self.server.start(_server_command(self._clock_offset_s()))
            case Fault.AGENT_KILL:
                self.team.kill(agent_id)
                self._start_agent(agent_id)
            case _:
                self._disturb(agent_id, fault)

    def _disturb(self, agent_id: str, fault: Fault) -> None:
        if fault is Fault.CUT:
            self.proxy.cut(agent_id)
        elif fault is Fault.STALL:
            self.proxy.stall(agent_id)
        else:
            self.proxy.delay(agent_id, self._random.uniform(0.01, _MAX_DELAY_S))
        self._pause()
        self.proxy.clear_faults(agent_id)

    def _kill_server(self) -> None:
        self._peak_mib = max(self._peak_mib, self.server.rss_mib())
        self.server.kill()
        # what has been acknowledged by now must be in the store; later acknowledgements were sent before
        self.team.read()
        self.comparisons.append(compare_store(self.team.acknowledged, self.folder / _STORE))

    def _fill_disk(self) -> None:
        """Let the server write at the beginning of its files only, so that its next commits fail as on a full disk."""
        self.faults[Fault.DISK_FULL] += 1
        # the log, in which it reports the errors, stays below the limit
        size = self.server.log.stat().st_size
        _, hard = resource.prlimit(self.server.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.server.pid, resource.RLIMIT_FSIZE, (size + _FREE_BYTES, hard))
        errors, limit_s = self._disk_errors(), time.monotonic() + _MAX_FULL_S
        while self._disk_errors() == errors and time.monotonic() < limit_s:
            threading.Event().wait(_POLL_S)
        if self._random.random() < 0.5:
            self._inject(Fault.SERVER_KILL)
        elif self.server.is_running:
            # the server has to go on without a restart when there is space again
            resource.prlimit(self.server.pid, resource.RLIMIT_FSIZE, (hard, hard))

    def _disk_errors(self) -> int:
        """Return how often the log reports them; it sums up those of a minute."""
        return self.server.log.read_text(errors="replace").count("disk I/O error")

    def _resend(self) -> None:
        """Send messages of the past again: duplicates, in another order."""
        chosen = self._random.choice(list(self.team.acknowledged))
        # another one stands in for an agent that has sent nothing yet
        for agent_id in (chosen, *self.team.acknowledged):
            acknowledged = self.team.acknowledged[agent_id]
            acknowledged.read()
            if acknowledged.sent:
                break
        # drawn also before the agent's first message, so that the seed alone decides the order of faults
        shares = [self._random.random() for _ in range(_RESENT_MESSAGES)]
        sent = list(acknowledged.sent)
        if sent:
            messages = [sent[int(share * len(sent))] for share in shares]
            limit_s, resent = time.monotonic() + _RESEND_LIMIT_S, 0
            while resent == 0 and time.monotonic() < limit_s:
                # an agent that joins again has another session, which its journal shows with its next message
                acknowledged.read()
                resent = asyncio.run(_resend_messages(self.server.address, acknowledged.session_id, messages))
            self.faults[Fault.RESEND] += resent

    def _start_agent(self, agent_id: str) -> None:
        self.team.start(agent_id, self._random.getrandbits(31), self._clock_offset_s())

    def _clock_offset_s(self) -> float:
        if self._random.random() > _CLOCK_SHARE:
            return 0.0
        self.faults[Fault.CLOCK_JUMP] += 1
        return self._random.uniform(-_DAY_S, _DAY_S)

    def _pause(self) -> None:
        threading.Event().wait(self._random.uniform(0.1, _MAX_FAULT_S))

    def _wait_for_progress(self) -> None:
        """Wait until the agents have sent some messages since the last fault, so that every fault meets a load."""
        target = self.team.messages + _PROGRESS_MESSAGES_PER_AGENT * self.settings.agents
        limit_s = time.monotonic() + _PROGRESS_S
        while self.team.messages < target:
            if time.monotonic() > limit_s or not self.server.is_running:
                raise UnavailableError(f"chaos: expected acknowledgements within {_PROGRESS_S:.0f} s after a fault")
            threading.Event().wait(_POLL_S)

    def _finish(self, begin_s: float) -> ChaosResult:
        self.team.finish()
        offline = offline_map(self.team.acknowledged)
        with FusionClient(self.server.address, deadline_s=60.0) as client:
            exported = client.export(Export())
        same_watch = self.watcher.wait_for(offline.batch, _WATCH_S)
        rss_mib = self.server.rss_mib()
        self._kill_server()
        parts, last = list(self.team.acknowledged.values()), self.comparisons[-1]
        return ChaosResult(
            faults={str(fault): self.faults[fault] for fault in Fault},
            acknowledged_messages=sum(part.messages for part in parts),
            acknowledged_updates=sum(part.updates for part in parts),
            disk_errors=self._disk_errors(),
            comparisons=len(self.comparisons),
            voxels=last.voxels,
            fused_voxels=len(offline.batch),
            lost=sum(comparison.lost for comparison in self.comparisons),
            wrong=sum(comparison.wrong for comparison in self.comparisons),
            extra_at_end=last.extra,
            same_map=exported == ply_bytes(offline.gaussians),
            same_watch=same_watch,
            server_errors=self.server.log.read_text(errors="replace").count("Traceback"),
            time_s=time.monotonic() - begin_s,
            rss_mib=(rss_mib, max(self._peak_mib, rss_mib)),
        )


async def _resend_messages(address: str, session_id: str, messages: list[bytes]) -> int:
    async with UpdateStreams(address) as streams:
        return await streams.open(session_id).resend(messages)


def _server_command(clock_offset_s: float) -> str:
    shifted = f"-m gausslite_bench.chaos.shifted_clock {clock_offset_s}"
    # the offline vote of the comparison knows no corrected frames
    return f"{shlex.quote(sys.executable)} {shifted} gausslite_fusion_server --set frame-alignment=trust"


def _ignore_sockets(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_socket()]
