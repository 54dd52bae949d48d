"""The agent names that operators have banned; they persist with the store."""

from __future__ import annotations

from gausslite.domain.errors import InvalidInputError, NotPermittedError
from gausslite.domain.names import quote_name
from gausslite.fusion.store import FusionStore

RECORD = "ban"
_BANNED, _ALLOWED = b"banned", b""


class BanList:
    """Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._agents = {agent_id for agent_id, data in store.records(RECORD).items() if data == _BANNED}

    @property
    def agents(self) -> tuple[str, ...]:
        """The banned agents, sorted."""
        return tuple(sorted(self._agents))

    def require_allowed(self, agent_id: str) -> None:
        """Raise NotPermittedError for a banned agent."""
        if agent_id in self._agents:
            raise NotPermittedError(f"agent {quote_name(agent_id)}: banned by an operator of this server")

    def add(self, agent_id: str) -> None:
        """Ban an agent. Call it after the agent's other records were deleted. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, _BANNED)
        self._agents.add(agent_id)

    def remove(self, agent_id: str) -> None:
        """Allow a banned agent again. Raises InvalidInputError if it is not banned, StorageError."""
        if agent_id not in self._agents:
            expected = ", ".join(self.agents[:8]) or "none is banned"
            raise InvalidInputError(f"agent_id: expected a banned agent ({expected}), got {quote_name(agent_id)}")
        self._store.save_record(agent_id, RECORD, _ALLOWED)
        self._agents.remove(agent_id)
