"""Run agents and a server through seeded faults, and compare what the server has with what it acknowledged."""

from __future__ import annotations

import random
import resource
import shutil
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.codec.ply import ply_bytes
from gausslite.config.option import option
from gausslite.domain.errors import UnavailableError
from gausslite.wire.clients import Export, FusionClient
from gausslite_bench.chaos.acknowledged import StoreComparison, compare_store, offline_map
from gausslite_bench.chaos.agent_team import AgentTeam
from gausslite_bench.chaos.fault_proxy import FaultProxy
from gausslite_bench.report import Report
from gausslite_bench.service_process import FUSION_SERVER, ServiceProcess

_STORE = "store.sqlite"
_PROGRESS_MESSAGES_PER_AGENT = 2
_PROGRESS_S = 120.0
_POLL_S = 0.02
_MAX_FAULT_S, _MAX_FULL_S = 1.0, 5.0
_DISK_FULL_SHARE = 0.15
_FREE_BYTES = 50_000


class Fault(StrEnum):
    """What is counted. The first four are the kills and partitions of a run."""

    SERVER_KILL = "server kills"
    AGENT_KILL = "agent kills"
    CUT = "cut connections"
    STALL = "stalled connections"
    DISK_FULL = "full disks"


_WEIGHTS = {Fault.SERVER_KILL: 3, Fault.AGENT_KILL: 3, Fault.CUT: 2, Fault.STALL: 1}


@dataclass(frozen=True, slots=True)
class ChaosSettings:
    """The options of `bench chaos`."""

    kills: int = option(200, "kills and partitions", low=1)
    agents: int = option(4, "agents that send", low=1, high=32)
    seed: int = option(0, "seed of all faults (default: 0)", low=0)
    out: Path | None = option(None, "keep the store, the spools and the logs there (default: no)", metavar="FOLDER")


def run_chaos(settings: ChaosSettings) -> Report:
    """Run the faults; the report is good if nothing that was acknowledged is lost or differs. Raises UnavailableError.

    lost, wrong: voxels, summed over the comparisons of the store after each kill of the server, and after the run.
    same_map: the map that the server exports at the end is the one computed offline, bit for bit.
    disk_errors: lines in the server's log about a disk that refuses to write; server_errors: unexpected errors there.
    """
    with tempfile.TemporaryDirectory() as name, ExitStack() as opened:
        folder = Path(name)
        if settings.out is not None:
            opened.callback(shutil.copytree, folder, settings.out, dirs_exist_ok=True, ignore=_ignore_sockets)
        agents = [f"agent-{number}" for number in range(settings.agents)]
        server = ServiceProcess(_server_command(folder), folder)
        opened.callback(server.kill)
        proxy = FaultProxy(folder, agents, Path(server.address.removeprefix("unix:")))
        opened.callback(proxy.close)
        team = AgentTeam(folder, agents, proxy.address)
        opened.callback(team.close)
        values = _ChaosRun(settings, folder, server, proxy, team).run()
    has_faults = any(values[name] for name in ("lost", "wrong", "extra_at_end", "server_errors"))
    return Report(values, is_good=bool(values["same_map"]) and not has_faults)


@dataclass(slots=True)
class _ChaosRun:
    """Runs the faults of one seed and counts them."""

    settings: ChaosSettings
    folder: Path
    server: ServiceProcess
    proxy: FaultProxy
    team: AgentTeam
    faults: Counter[Fault] = field(default_factory=Counter)
    comparisons: list[StoreComparison] = field(default_factory=list)
    _random: random.Random = field(init=False)
    _peak_mib: float = 0.0

    def run(self) -> dict[str, object]:
        begin_s = time.monotonic()
        self._random = random.Random(self.settings.seed)  # noqa: S311 - reproducible faults
        for agent_id in self.team.acknowledged:
            self._start_agent(agent_id)
        with progress_bar(self.settings.kills, "chaos", "fault") as progress:
            for _ in range(self.settings.kills):
                self._wait_for_progress()
                if self._random.random() < _DISK_FULL_SHARE:
                    self._fill_disk()
                self._inject(self._random.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0])
                progress.update()
        return self._finish(begin_s)

    def _inject(self, fault: Fault) -> None:
        self.faults[fault] += 1
        agent_id = self._random.choice(list(self.team.acknowledged))
        match fault:
            case Fault.SERVER_KILL:
                self._kill_server()
                self.server.start()
            case Fault.AGENT_KILL:
                self.team.kill(agent_id)
                self._start_agent(agent_id)
            case _:
                self.proxy.set_fault(agent_id, is_cut=fault is Fault.CUT, is_stalled=fault is Fault.STALL)
                threading.Event().wait(self._random.uniform(0.1, _MAX_FAULT_S))
                self.proxy.set_fault(agent_id)

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

    def _start_agent(self, agent_id: str) -> None:
        self.team.start(agent_id, self._random.getrandbits(31))

    def _wait_for_progress(self) -> None:
        """Wait until the agents have sent some messages since the last fault, so that every fault meets a load."""
        target = self.team.messages + _PROGRESS_MESSAGES_PER_AGENT * self.settings.agents
        limit_s = time.monotonic() + _PROGRESS_S
        while self.team.messages < target:
            if time.monotonic() > limit_s or not self.server.is_running:
                raise UnavailableError(f"chaos: expected acknowledgements within {_PROGRESS_S:.0f} s after a fault")
            threading.Event().wait(_POLL_S)

    def _finish(self, begin_s: float) -> dict[str, object]:
        self.team.finish()
        offline = offline_map(self.team.acknowledged)
        with FusionClient(self.server.address, deadline_s=60.0) as client:
            exported = client.export(Export())
        rss_mib = self.server.rss_mib()
        self._kill_server()
        parts, last = list(self.team.acknowledged.values()), self.comparisons[-1]
        return {
            "seed": self.settings.seed,
            "faults": {str(fault): self.faults[fault] for fault in Fault},
            "acknowledged_messages": sum(part.messages for part in parts),
            "acknowledged_updates": sum(part.updates for part in parts),
            "disk_errors": self._disk_errors(),
            "comparisons": len(self.comparisons),
            "voxels": last.voxels,
            "fused_voxels": len(offline.batch),
            "lost": sum(comparison.lost for comparison in self.comparisons),
            "wrong": sum(comparison.wrong for comparison in self.comparisons),
            "extra_at_end": last.extra,
            "same_map": exported == ply_bytes(offline.batch.gaussians),
            "server_errors": self.server.unexpected_errors,
            "time_s": time.monotonic() - begin_s,
            "rss_mib_at_end": rss_mib,
            "rss_mib_at_most": max(self._peak_mib, rss_mib),
        }


def _server_command(folder: Path) -> str:
    # the offline vote of the comparison knows no corrected frames
    return f"{FUSION_SERVER} --set frame-alignment=trust --store {folder / _STORE}"


def _ignore_sockets(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_socket()]
