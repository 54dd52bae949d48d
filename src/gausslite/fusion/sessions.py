"""The open sessions of a mission: one per agent; joining again replaces the earlier one."""

from __future__ import annotations

import secrets
from collections import deque

from gausslite.domain.errors import MismatchError, SessionUnknownError
from gausslite.domain.names import quote_name
from gausslite.fusion.store import FusionStore, SessionRecord

_MAX_REPLACED_SESSIONS = 1000


class SessionRegistry:
    """Opens, finds and ends sessions; they persist with the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._sessions = {session.session_id: session for session in store.sessions()}
        self._replaced: deque[str] = deque(maxlen=_MAX_REPLACED_SESSIONS)

    @property
    def agents(self) -> frozenset[str]:
        """The agents that have a session."""
        return frozenset(session.agent_id for session in self._sessions.values())

    def open(self, agent_id: str) -> SessionRecord:
        """Return a new session; the agent's earlier one ends."""
        session = SessionRecord(secrets.token_hex(16), agent_id)
        self._store.save_session(session)
        for replaced in [key for key, old in self._sessions.items() if old.agent_id == agent_id]:
            del self._sessions[replaced]
            self._replaced.append(replaced)
        self._sessions[session.session_id] = session
        return session

    def get(self, session_id: str) -> SessionRecord:
        """Return the session of this id. Raises SessionUnknownError, and MismatchError for a replaced session.

        An agent never uses a session after it has joined again, so a second robot has the same name. If the first
        one joined again on this error, the two would end each other's sessions forever.
        """
        session = self._sessions.get(session_id)
        if session_id in self._replaced:
            raise MismatchError("session: another robot has joined under this name; give each its own agent id")
        if session is None:
            raise SessionUnknownError(
                f"session {quote_name(session_id)}: unknown to this server; join, then send every voxel again"
            )
        return session

    def end(self, session_id: str) -> None:
        """End a session. Raises SessionUnknownError, MismatchError."""
        self.get(session_id)
        self._store.end_session(session_id)
        del self._sessions[session_id]
