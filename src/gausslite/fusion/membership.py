"""Decide who takes part in a mission: its configuration, sessions under a lease, bans and the number of agents."""

from __future__ import annotations

import hashlib
import logging
import secrets
import time
from collections import deque
from collections.abc import Callable, Collection
from threading import Lock

from gausslite.domain import errors
from gausslite.domain.checks import quote_name, require_identifier
from gausslite.fusion.epochs import agent_of
from gausslite.fusion.limits import FusionSettings, MissionConfig, SessionRecord, reconcile
from gausslite.fusion.store import FusionStore

_log = logging.getLogger(__name__)
RECORD = "ban"
_BANNED = b"banned"
_MAX_REPLACED_SESSIONS = 1000
TOKEN_RECORD = "join-token"  # noqa: S105 - the name of a record
_NAME_TAKEN = "another robot uses this name; give each its own agent id"


class BanList:
    """The banned agents. Reads are safe in any thread, changes come one by one."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self.agents = tuple(sorted(name for name, data in store.records(RECORD).items() if data == _BANNED))
        """Sorted."""

    def require_allowed(self, agent_id: str) -> None:
        """Raise NotPermittedError for a banned agent."""
        if agent_id in self.agents:
            raise errors.NotPermittedError(f"agent {quote_name(agent_id)}: banned by an operator of this server")

    def add(self, agent_id: str) -> None:
        """Ban an agent. Call it after the agent's other records were deleted. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, _BANNED)
        self.agents = tuple(sorted({*self.agents, agent_id}))

    def remove(self, agent_id: str) -> None:
        """Allow a banned agent again. Raises InvalidInputError if it is not banned, StorageError."""
        if agent_id not in self.agents:
            expected = ", ".join(self.agents[:8]) or "none is banned"
            raise errors.InvalidInputError(
                f"agent_id: expected a banned agent ({expected}), got {quote_name(agent_id)}"
            )
        # it has nothing else
        self._store.remove_agent(agent_id)
        self.agents = tuple(name for name in self.agents if name != agent_id)


class SessionRegistry:
    """Opens, finds and ends sessions; they persist with the store. Changes come one by one, reads in any thread.

    A lease lasts `lease_s` after the session's last use; clock_s: the time in seconds. Only a join with the token of
    the earlier one replaces a session before its lease has ended. The store has only the tokens' SHA-256. Sessions that
    other servers of the store have opened are valid here too; their leases are kept there.
    """

    def __init__(self, store: FusionStore, lease_s: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._store, self._lease_s, self._clock_s = store, lease_s, clock_s
        # held for a moment, never during a call of the store: each message asks for its session
        self._lock = Lock()
        self._elsewhere: dict[str, SessionRecord] = {}
        self._sessions = {session.session_id: session for session in store.sessions()}
        # in the order of the agents' first sessions; after a restart, each robot has a whole lease to come back
        self._lease_ends_s = {session.agent_id: clock_s() + lease_s for session in self._sessions.values()}
        self._token_hashes = store.records(TOKEN_RECORD)
        # replaced sessions, and whether the same token replaced them
        self._replaced: deque[tuple[str, bool]] = deque(maxlen=_MAX_REPLACED_SESSIONS)

    @property
    def agents(self) -> frozenset[str]:
        """The agents that have a session."""
        with self._lock:
            return frozenset(session.agent_id for session in self._sessions.values())

    @property
    def live_agents(self) -> frozenset[str]:
        """The agents that have a session whose lease has not ended."""
        return frozenset(agent_id for agent_id in self.agents if self._remaining_s(agent_id) > 0)

    def require_free(self, agent_id: str, token: str) -> None:
        """Raise NameInUseError while another token holds the agent's lease."""
        remaining_s = self._remaining_s(agent_id)
        if remaining_s > 0 and not self._is_holder(agent_id, token):
            raise errors.NameInUseError(
                f"agent {quote_name(agent_id)}: {_NAME_TAKEN}, or wait {remaining_s:.0f} s for the end of its lease",
                retry_after_s=remaining_s,
            )

    def open(self, agent_id: str, token: str) -> SessionRecord:
        """Return a new session; the agent's earlier one ends. Raises NameInUseError, StorageError."""
        self.require_free(agent_id, token)
        is_holder = self._is_holder(agent_id, token)
        session = SessionRecord(secrets.token_hex(16), agent_id)
        self.save(session, token)
        with self._lock:
            for replaced in self._sessions_of(agent_id):
                del self._sessions[replaced]
                self._replaced.append((replaced, is_holder))
            self._sessions[session.session_id] = session
            self._lease_ends_s[agent_id] = self._clock_s() + self._lease_s
        return session

    def save(self, session: SessionRecord, token: str) -> None:
        """Store a session and its token, also again after the agent's records were deleted. Raises StorageError."""
        self._store.save_record(session.agent_id, TOKEN_RECORD, _hash(token))
        self._store.save_session(session)
        self._token_hashes[session.agent_id] = _hash(token)

    def known(self, session_id: str) -> SessionRecord | None:
        """Return the session if it is known without the store, and renew its lease; in any thread, at once."""
        lease_end_s = self._clock_s() + self._lease_s
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None:
                return self._elsewhere.get(session_id)
            self._lease_ends_s[session.agent_id] = lease_end_s
        return session

    def get(self, session_id: str) -> SessionRecord:
        """Return the session of this id and renew its lease.

        Raises SessionUnknownError; NameInUseError if the lease had ended and another robot has joined since;
        MismatchError if a second robot with the same token has joined: an agent never uses a session after it has
        joined again, and two such robots would end each other's sessions forever.
        """
        session = self.known(session_id)
        if session is not None:
            return session
        with self._lock:
            replaced = dict(self._replaced)
        if session_id in replaced:
            if replaced[session_id]:
                raise errors.MismatchError(f"session: {_NAME_TAKEN}")
            error = errors.NameInUseError(f"session: {_NAME_TAKEN}")
            error.retry_after_s = self._lease_s
            raise error
        elsewhere = self._store.find_session(session_id)
        if elsewhere is None:
            raise errors.SessionUnknownError(f"session {quote_name(session_id)}: unknown to this server; join again")
        with self._lock:
            self._elsewhere[session_id] = elsewhere
        return elsewhere

    def forget_elsewhere(self, agent_id: str) -> None:
        """Ask the store again for the session of an agent that another server has opened."""
        with self._lock:
            for session_id in [key for key, session in self._elsewhere.items() if session.agent_id == agent_id]:
                del self._elsewhere[session_id]

    def end_agent(self, agent_id: str) -> None:
        """End the session and the lease of an agent, if it has one. Raises StorageError."""
        for session_id in self._sessions_of(agent_id):
            self._store.end_session(session_id)
            with self._lock:
                del self._sessions[session_id]
        with self._lock:
            self._lease_ends_s.pop(agent_id, None)

    def end_unused(self, kept: Collection[str]) -> list[str]:
        """End the sessions whose lease has ended, except those of `kept`; return their agents. Raises StorageError."""
        now_s = self._clock_s()
        with self._lock:
            ended = [name for name, end_s in self._lease_ends_s.items() if name not in kept and end_s <= now_s]
        for agent_id in ended:
            self.end_agent(agent_id)
        return ended

    def remove_agent(self, agent_id: str) -> None:
        """Delete the token of an agent; the store deletes it with the agent's updates."""
        self._token_hashes.pop(agent_id, None)

    def _sessions_of(self, agent_id: str) -> list[str]:
        return [key for key, session in self._sessions.items() if session.agent_id == agent_id]

    def _remaining_s(self, agent_id: str) -> float:
        return self._lease_ends_s.get(agent_id, -float("inf")) - self._clock_s()

    def _is_holder(self, agent_id: str, token: str) -> bool:
        return secrets.compare_digest(self._token_hashes.get(agent_id, b""), _hash(token))


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()


class Membership:
    """Owns the mission's configuration, `sessions` and `bans`. Reads are safe in any thread, changes come one by one.

    Raises MismatchError if the store belongs to another mission configuration, StorageError.
    """

    def __init__(self, store: FusionStore, settings: FusionSettings) -> None:
        self._store, self._settings = store, settings
        own, self._stored_config = settings.mission_config, store.mission_config()
        self._mission_config = reconcile(self._stored_config or own, own)
        self.sessions = SessionRegistry(store, settings.lease_s)
        self.bans = BanList(store)
        self._most_agents = len(self._agents())

    @property
    def mission_config(self) -> MissionConfig:
        """The mission's configuration, with default names in place of empty ones."""
        return self._mission_config.with_default_names()

    def require_mission(self, mission_id: str) -> None:
        """Raise MismatchError unless the id is this mission's, or empty."""
        own = self.mission_config.mission_id
        if mission_id and mission_id != own:
            raise errors.MismatchError(
                f"mission: expected {quote_name(own)} as agreed here, got {quote_name(mission_id)}"
            )

    @property
    def sources(self) -> frozenset[str]:
        """The agents with a session or with data, and the names of former maps."""
        return self.sessions.agents | frozenset(self._store.agents())

    def admit(self, agent_id: str, requested: MissionConfig, token: str) -> list[str]:
        """Check that the agent may join, and agree on the mission's configuration.

        Returns the agents without updates whose sessions have ended to make room; they can join again.
        Raises InvalidInputError, MismatchError, NameInUseError, NotPermittedError, QuotaError, StorageError.
        """
        require_identifier("agent_id", agent_id)
        self.bans.require_allowed(agent_id)
        self.sessions.require_free(agent_id, token)
        ended = self._make_room(agent_id)
        # another live agent, or any data, fixes it
        is_agreed = bool(self._store.agents() or self.sessions.live_agents - {agent_id})
        agreed = self._mission_config if is_agreed else self._settings.mission_config
        mission_config = reconcile(agreed, requested).with_default_names()
        if mission_config != self._stored_config:
            self._store.set_mission_config(mission_config)
            self._stored_config = mission_config
        self._mission_config = mission_config
        return ended

    def open_session(self, agent_id: str, token: str) -> SessionRecord:
        """Return a new session of an admitted agent; its earlier one ends. Raises NameInUseError, StorageError."""
        session, agents = self.sessions.open(agent_id, token), len(self._agents())
        # names that come and go fill no log
        if agents > self._most_agents:
            self._most_agents, limit = agents, self._settings.quotas.agents
            _log.info("agent %s has joined; %d of at most %d names are in use", quote_name(agent_id), agents, limit)
        return session

    def require_evictable(self, agent_id: str, ban: bool) -> None:
        """Raise InvalidInputError for an unknown agent, or with `ban` for a name that no agent can have."""
        if ban:
            require_identifier("agent_id", agent_id)
        elif agent_id not in self.sources:
            expected = ", ".join(sorted(self.sources)[:8]) or "no agents yet"
            raise errors.InvalidInputError(
                f"agent_id: expected an agent of the mission ({expected}), got {quote_name(agent_id)}"
            )

    def _make_room(self, agent_id: str) -> list[str]:
        """End the sessions of agents without updates whose lease has ended, if the mission is full; returns them.

        No join ends the lease of another agent that uses it. Raises QuotaError, StorageError.
        """
        limit = self._settings.quotas.agents
        if agent_id in self._agents() or len(self._agents()) < limit:
            return []
        ended = self.sessions.end_unused(kept=frozenset(self._store.agents()))
        if len(self._agents()) >= limit:
            raise errors.QuotaError(
                f"agents: expected at most {limit} in this mission, {quote_name(agent_id)} exceeds it; names without "
                "data are free again when their leases end, or with gausslite evict"
            )
        return ended

    def _agents(self) -> frozenset[str]:
        return frozenset(map(agent_of, self.sources))
