"""The sessions of a mission: one per agent, held under a lease, so that nobody takes over the name of a live robot."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import deque
from collections.abc import Callable, Collection

from gausslite.domain.errors import MismatchError, NameInUseError, SessionUnknownError
from gausslite.domain.names import quote_name
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import SessionRecord

_MAX_REPLACED_SESSIONS = 1000
TOKEN_RECORD = "join-token"  # noqa: S105 - the name of a record
_NAME_TAKEN = "another robot uses this name; give each its own agent id"


class SessionRegistry:
    """Opens, finds and ends sessions; they persist with the store. Not thread-safe; FusionEngine holds a lock.

    A lease lasts `lease_s` after the session's last use; clock_s: the time in seconds. Only a join with the token of
    the earlier one replaces a session before its lease has ended. The store has only the tokens' SHA-256.
    """

    def __init__(self, store: FusionStore, lease_s: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._store, self._lease_s, self._clock_s = store, lease_s, clock_s
        self._sessions = {session.session_id: session for session in store.sessions()}
        # after a restart of the server, each robot has a whole lease to come back
        self._lease_ends_s = {session.agent_id: clock_s() + lease_s for session in self._sessions.values()}
        self._token_hashes = store.records(TOKEN_RECORD)
        # replaced sessions, and whether the same token replaced them
        self._replaced: deque[tuple[str, bool]] = deque(maxlen=_MAX_REPLACED_SESSIONS)

    @property
    def agents(self) -> frozenset[str]:
        """The agents that have a session."""
        return frozenset(session.agent_id for session in self._sessions.values())

    @property
    def live_agents(self) -> frozenset[str]:
        """The agents that have a session whose lease has not ended."""
        return frozenset(agent_id for agent_id in self.agents if self._remaining_s(agent_id) > 0)

    def require_free(self, agent_id: str, token: str) -> None:
        """Raise NameInUseError while another token holds the agent's lease."""
        remaining_s = self._remaining_s(agent_id)
        if remaining_s > 0 and not self._is_holder(agent_id, token):
            raise _name_in_use(agent_id, remaining_s)

    def open(self, agent_id: str, token: str) -> SessionRecord:
        """Return a new session; the agent's earlier one ends. Raises NameInUseError, StorageError."""
        self.require_free(agent_id, token)
        is_holder = self._is_holder(agent_id, token)
        session = SessionRecord(secrets.token_hex(16), agent_id)
        self.save_token(agent_id, token)
        self._store.save_session(session)
        for replaced in self._sessions_of(agent_id):
            del self._sessions[replaced]
            self._replaced.append((replaced, is_holder))
        self._sessions[session.session_id] = session
        self._renew(agent_id)
        return session

    def save_token(self, agent_id: str, token: str) -> None:
        """Store the token of an agent's session, also after its other records were deleted. Raises StorageError."""
        self._store.save_record(agent_id, TOKEN_RECORD, _hash(token))
        self._token_hashes[agent_id] = _hash(token)

    def get(self, session_id: str) -> SessionRecord:
        """Return the session of this id and renew its lease.

        Raises SessionUnknownError; NameInUseError if the lease had ended and another robot has joined since;
        MismatchError if a second robot with the same token has joined: an agent never uses a session after it has
        joined again, and two such robots would end each other's sessions forever.
        """
        session = self._sessions.get(session_id)
        if session is not None:
            self._renew(session.agent_id)
            return session
        if (session_id, True) in self._replaced:
            raise MismatchError(f"session: {_NAME_TAKEN}")
        if (session_id, False) in self._replaced:
            error = NameInUseError(f"session: {_NAME_TAKEN}")
            error.retry_after_s = self._lease_s
            raise error
        raise SessionUnknownError(f"session {quote_name(session_id)}: unknown to this server; join again")

    def end(self, session_id: str) -> None:
        """End a session and its lease. Raises SessionUnknownError, MismatchError, NameInUseError, StorageError."""
        self.end_agent(self.get(session_id).agent_id)

    def end_agent(self, agent_id: str) -> None:
        """End the session and the lease of an agent, if it has one. Raises StorageError."""
        for session_id in self._sessions_of(agent_id):
            self._store.end_session(session_id)
            del self._sessions[session_id]
        self._lease_ends_s.pop(agent_id, None)

    def end_expired(self, kept: Collection[str]) -> None:
        """End the sessions whose lease has ended, except those of the agents in `kept`. Raises StorageError."""
        for agent_id in self.agents.difference(kept):
            if self._remaining_s(agent_id) <= 0:
                self.end_agent(agent_id)

    def _sessions_of(self, agent_id: str) -> list[str]:
        return [key for key, session in self._sessions.items() if session.agent_id == agent_id]

    def _renew(self, agent_id: str) -> None:
        self._lease_ends_s[agent_id] = self._clock_s() + self._lease_s

    def _remaining_s(self, agent_id: str) -> float:
        return self._lease_ends_s.get(agent_id, -float("inf")) - self._clock_s()

    def _is_holder(self, agent_id: str, token: str) -> bool:
        return secrets.compare_digest(self._token_hashes.get(agent_id, b""), _hash(token))


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()


def _name_in_use(agent_id: str, remaining_s: float) -> NameInUseError:
    error = NameInUseError(
        f"agent {quote_name(agent_id)}: {_NAME_TAKEN}, or wait {remaining_s:.0f} s for the end of its lease"
    )
    error.retry_after_s = remaining_s
    return error
