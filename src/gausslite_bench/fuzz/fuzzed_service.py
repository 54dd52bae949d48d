"""Start a service as its own process, with small limits, and watch whether it runs and how much memory it uses."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gausslite.domain.errors import NameInUseError, NotPermittedError, UnavailableError
from gausslite.wire.channel import require_serving
from gausslite.wire.clients import FusionClient
from gausslite_bench.fuzz.corpus import AGENT_ID
from gausslite_bench.loop.memory import resident_mib
from gausslite_bench.server.synthetic_updates import GRID

FUSION, AGENT = "FusionService", "AgentService"
COMMANDS: Mapping[str, tuple[str, ...]] = {
    FUSION: (
        "gausslite_fusion_server",
        *("--set", "quota-agents=200", "--set", "quota-voxels=2000", "--set", "quota-gaussians=20000"),
        *("--set", "quota-keyframes=8", "--set", "refine-iterations=2", "--mission", "mission"),
    ),
    AGENT: (
        "gausslite_agent",
        *("--iterations", "1", "--max-gaussians", "2000", "--set", "threads=1"),
    ),
    "ParserService": ("gausslite_parser",),
}
"""The program of each service. Small quotas are full soon, so that memory which grows later is a leak."""
_START_S = 120.0
_POLL_S = 0.05
_TOKEN = "fuzzer"  # noqa: S105 - of the agent that the corpus contributes as


@dataclass(slots=True)
class FuzzedService:
    """Owns the process of one service; the log is a file."""

    name: str
    address: str
    log: Path
    _process: subprocess.Popen[bytes]

    @classmethod
    def start(cls, name: str, folder: Path, options: Sequence[str] = ()) -> FuzzedService:
        """Start the service and wait until it serves. Raises UnavailableError."""
        address, log = f"unix:{folder}/{name}.sock", folder / f"{name}.log"
        command = [sys.executable, "-m", *COMMANDS[name], "--listen", address, *options]
        with log.open("ab") as file:
            service = cls(name, address, log, subprocess.Popen(command, stderr=file))  # noqa: S603 - our own programs
        limit_s = time.monotonic() + _START_S
        while service.is_running and time.monotonic() < limit_s:
            if Path(address.removeprefix("unix:")).exists():
                try:
                    require_serving(address, None)
                except UnavailableError:
                    pass
                else:
                    return service
            time.sleep(_POLL_S)
        service.close()
        raise UnavailableError(f"{name}: expected it to start, got: {log.read_text(errors='replace')[-500:]}")

    @property
    def is_running(self) -> bool:
        """False after the process has ended."""
        return self._process.poll() is None

    @property
    def unexpected_errors(self) -> int:
        """Errors in the log that a method did not expect."""
        return self.log.read_text(errors="replace").count("Traceback (most recent call last)")

    def rss_mib(self) -> float:
        """Return the resident memory of the process."""
        return resident_mib(self._process.pid)

    def open_session(self) -> bytes:
        """Return a session id of the corpus's agent; empty for a service without sessions."""
        if self.name != FUSION:
            return b""
        with FusionClient(self.address, deadline_s=60.0, token=_TOKEN) as client:
            try:
                return client.join(AGENT_ID, GRID).session_id.encode()
            except NotPermittedError:
                # a mutated message has banned the agent
                client.unban(AGENT_ID)
                return client.join(AGENT_ID, GRID).session_id.encode()
            except NameInUseError:
                # a mutated message has joined under its name with another token
                client.evict(AGENT_ID)
                return client.join(AGENT_ID, GRID).session_id.encode()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
