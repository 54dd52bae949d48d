"""Start, kill and end the processes of all agents, and follow what is acknowledged to each."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gausslite.domain.errors import UnavailableError
from gausslite_bench.chaos.acknowledged import AgentAcknowledgements
from gausslite_bench.chaos.agent_process import DRAIN_S

_END_S = DRAIN_S + 60.0


class AgentTeam:
    """Owns one process per agent. The spools and journals are files in `folder`."""

    def __init__(self, folder: Path, names: Sequence[str], address_of: Callable[[str], str]) -> None:
        self._folder, self._address_of = folder, address_of
        self.acknowledged = {name: AgentAcknowledgements() for name in names}
        self._lives = {name: itertools.count() for name in names}
        self._processes: dict[str, subprocess.Popen[str]] = {}

    @property
    def messages(self) -> int:
        """Acknowledged messages of all agents until now."""
        self.read()
        return sum(journal.messages for journal in self.acknowledged.values())

    def read(self) -> None:
        """Read the new records of all journals."""
        for journal in self.acknowledged.values():
            journal.read()

    def start(self, agent_id: str, seed: int) -> None:
        """Start an agent on its spool."""
        journal = self._folder / f"{agent_id}-{next(self._lives[agent_id])}.journal"
        spool = self._folder / f"{agent_id}.spool"
        settings = agent_id, self._address_of(agent_id), str(spool), str(journal), seed
        self.acknowledged[agent_id].add_journal(journal)
        command = [sys.executable, "-m", "gausslite_bench.chaos.agent_process", json.dumps(settings)]
        with (self._folder / "agents.log").open("ab") as log:
            self._processes[agent_id] = subprocess.Popen(  # noqa: S603 - this program
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )

    def kill(self, agent_id: str) -> None:
        """End an agent's process at once."""
        process = self._processes.pop(agent_id)
        process.kill()
        process.communicate()

    def finish(self) -> None:
        """Let every agent send what it has left, and end. Raises UnavailableError if one cannot."""
        for process in self._processes.values():
            if process.stdin is not None:
                process.stdin.close()
                process.stdin = None
        for agent_id, process in self._processes.items():
            try:
                output, _ = process.communicate(timeout=_END_S)
            except subprocess.TimeoutExpired:
                output = ""
            end = json.loads(output or "{}")
            if not end.get("drained"):
                reason = end.get("stopped_because") or f"not everything was acknowledged within {_END_S:.0f} s"
                raise UnavailableError(f"{agent_id}: expected it to send everything at the end: {reason}")
        self.read()

    def close(self) -> None:
        """End the processes that are left."""
        for agent_id in tuple(self._processes):
            self.kill(agent_id)
