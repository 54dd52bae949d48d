"""Start, kill and end the processes of all agents, and follow what is acknowledged to each."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

from gausslite.domain.errors import UnavailableError
from gausslite_bench.chaos import agent
from gausslite_bench.chaos.acknowledged import AgentAcknowledgements

_END_S, _POLL_S = agent.DRAIN_S + 60.0, 0.05
# a fork would share gRPC's threads and sockets
_SPAWN = multiprocessing.get_context("spawn")


class AgentTeam:
    """Owns one process per agent. The spools and the log are files in `folder`."""

    def __init__(self, folder: Path, names: Sequence[str], address_of: Callable[[str], str]) -> None:
        self._folder, self._address_of = folder, address_of
        self.acknowledged = {name: AgentAcknowledgements() for name in names}
        self._processes: dict[str, tuple[multiprocessing.process.BaseProcess, Connection]] = {}

    @property
    def messages(self) -> int:
        """Acknowledged messages of all agents until now."""
        self.read()
        return sum(acknowledged.messages for acknowledged in self.acknowledged.values())

    def read(self) -> None:
        """Read the new records of all agents."""
        for acknowledged in self.acknowledged.values():
            acknowledged.read()

    def start(self, agent_id: str, seed: int) -> None:
        """Start an agent on its spool."""
        own, pipe = _SPAWN.Pipe()
        self.acknowledged[agent_id].follow(own)
        arguments = agent_id, self._address_of(agent_id), self._folder, seed, pipe
        process = _SPAWN.Process(target=agent.run, args=arguments, daemon=True)
        process.start()
        pipe.close()  # else its end would stay open when the process ends
        self._processes[agent_id] = process, own

    def kill(self, agent_id: str) -> None:
        """End an agent's process at once."""
        process, _ = self._processes.pop(agent_id)
        process.kill()
        process.join()

    def finish(self) -> None:
        """Let every agent send what it has left, and end. Raises UnavailableError if one cannot."""
        for _, pipe in self._processes.values():
            pipe.send("end")
        limit_s = time.monotonic() + _END_S
        for agent_id, (process, _) in self._processes.items():
            # they wait while nobody reads their records
            while process.is_alive() and time.monotonic() < limit_s:
                self.read()
                process.join(_POLL_S)
            if process.exitcode != 0:
                log = (self._folder / agent.LOG).read_text(errors="replace")[-500:]
                raise UnavailableError(f"{agent_id}: expected it to send everything at the end: {log}")
        self.read()

    def close(self) -> None:
        """End the processes that are left."""
        for agent_id in tuple(self._processes):
            self.kill(agent_id)
