"""Decide who takes part in a mission: its configuration, the sessions, the bans and the number of agents."""

from __future__ import annotations

from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.names import quote_name, require_identifier
from gausslite.fusion.agent_data import is_earlier_map
from gausslite.fusion.bans import BanList
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.mission_config import MissionConfig, reconcile
from gausslite.fusion.sessions import SessionRegistry
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import SessionRecord


class Membership:
    """Owns the mission's configuration, the sessions and the bans. Not thread-safe; FusionEngine holds a lock.

    Raises MismatchError if the store belongs to another mission configuration, StorageError.
    """

    def __init__(self, store: FusionStore, settings: FusionSettings) -> None:
        self._store, self._settings = store, settings
        own = settings.mission_config
        self._mission_config = reconcile(store.mission_config() or own, own)
        self._sessions = SessionRegistry(store, settings.lease_s)
        self._bans = BanList(store)

    @property
    def mission_config(self) -> MissionConfig:
        """The mission's configuration, with default names in place of empty ones."""
        return self._mission_config.with_default_names()

    @property
    def banned(self) -> tuple[str, ...]:
        """The names that operators have banned."""
        return self._bans.agents

    @property
    def joined(self) -> frozenset[str]:
        """The agents that have a session."""
        return self._sessions.agents

    @property
    def sources(self) -> frozenset[str]:
        """The agents with a session or with data, and the names of earlier maps."""
        return self.joined | frozenset(self._store.agents())

    def session(self, session_id: str) -> SessionRecord:
        """Return the session of this id, see SessionRegistry.get."""
        return self._sessions.get(session_id)

    def admit(self, agent_id: str, requested: MissionConfig, token: str) -> None:
        """Check that the agent may join, and agree on the mission's configuration.

        Raises InvalidInputError, MismatchError, NameInUseError, NotPermittedError, QuotaError, StorageError.
        """
        require_identifier("agent_id", agent_id)
        self._bans.require_allowed(agent_id)
        self._sessions.require_free(agent_id, token)
        self._make_room(agent_id)
        agreed = self._mission_config if self._is_agreed(agent_id) else self._settings.mission_config
        mission_config = reconcile(agreed, requested).with_default_names()
        self._store.set_mission_config(mission_config)
        self._mission_config = mission_config

    def open_session(self, agent_id: str, token: str) -> SessionRecord:
        """Return a new session of an admitted agent; its earlier one ends. Raises NameInUseError, StorageError."""
        return self._sessions.open(agent_id, token)

    def save_token(self, agent_id: str, token: str) -> None:
        """Store the token of the agent's session again, see SessionRegistry."""
        self._sessions.save_token(agent_id, token)

    def end_session(self, session_id: str) -> None:
        """End a session, see SessionRegistry.end."""
        self._sessions.end(session_id)

    def require_evictable(self, agent_id: str, ban: bool) -> None:
        """Raise InvalidInputError for an unknown agent, or with `ban` for a name that no agent can have."""
        if ban:
            require_identifier("agent_id", agent_id)
        elif agent_id not in self.sources:
            expected = ", ".join(sorted(self.sources)[:8]) or "no agents yet"
            raise InvalidInputError(
                f"agent_id: expected an agent of the mission ({expected}), got {quote_name(agent_id)}"
            )

    def end_agent(self, agent_id: str) -> None:
        """End the session of an agent, if it has one. Raises StorageError."""
        self._sessions.end_agent(agent_id)

    def ban(self, agent_id: str) -> None:
        """Refuse later joins under this name. Raises StorageError."""
        self._bans.add(agent_id)

    def unban(self, agent_id: str) -> None:
        """Let a banned agent join again. Raises InvalidInputError if it is not banned, StorageError."""
        self._bans.remove(agent_id)

    def _is_agreed(self, agent_id: str) -> bool:
        """Return whether another live agent, or any data, fixes the mission's configuration."""
        return bool(frozenset(self._store.agents()) or self._sessions.live_agents - {agent_id})

    def _make_room(self, agent_id: str) -> None:
        """End sessions without a lease and without data if the mission is full. Raises QuotaError, StorageError."""
        limit = self._settings.quotas.agents
        if agent_id in self._agents() or len(self._agents()) < limit:
            return
        self._sessions.end_expired(kept=frozenset(self._store.agents()))
        if len(self._agents()) >= limit:
            raise QuotaError(f"agents: expected at most {limit} in this mission, {quote_name(agent_id)} exceeds it")

    def _agents(self) -> frozenset[str]:
        return frozenset(name for name in self.sources if not is_earlier_map(name))
