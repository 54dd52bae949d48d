"""Refuse data of sessions that have ended, also from a server that does not know it yet."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable

from gausslite.cluster.store_calls import StoreCall
from gausslite.domain.errors import SessionUnknownError
from gausslite.domain.names import quote_name
from gausslite.fusion.store_values import SessionRecord

_MAX_ENDED = 10_000
_OF_JOINED_AGENTS = frozenset({"objects", "free_space"})
"""Records that an agent sends; the others are the server's own."""


class SessionFence:
    """Knows the open sessions and the latest ended ones. Not thread-safe; ShardReplica holds a lock.

    Every shard has every session. So when a session has ended in all shards, no server can store its data any more,
    and what is deleted afterwards stays deleted.
    """

    def __init__(self, sessions: Iterable[SessionRecord]) -> None:
        self._session_of = {session.agent_id: session.session_id for session in sessions}
        self._ended: OrderedDict[str, str] = OrderedDict()

    def require_open(self, call: StoreCall) -> None:
        """Raise SessionUnknownError if a call has data of an ended session, or of an agent whose session has ended."""
        match call.method, call.arguments:
            case "put_all", (subsets,):
                for subset in subsets:
                    self._require_session(subset.agent_id, subset.session_id)
            case "save_keyframe", (agent_id, *_):
                self._require_joined(agent_id)
            case "save_record", (agent_id, name, _) if name in _OF_JOINED_AGENTS:
                self._require_joined(agent_id)

    def record(self, call: StoreCall) -> None:
        """Note a call that opens or ends a session."""
        match call.method, call.arguments:
            case "save_session", (session,):
                # after a lost reply the same session is saved again
                if self._session_of.get(session.agent_id) != session.session_id:
                    self._end(session.agent_id)
                self._session_of[session.agent_id] = session.session_id
            case "end_session", (session_id,):
                for agent_id in [name for name, own in self._session_of.items() if own == session_id]:
                    self._end(agent_id)

    def _end(self, agent_id: str) -> None:
        session_id = self._session_of.pop(agent_id, None)
        if session_id is not None:
            self._ended[session_id] = agent_id
            if len(self._ended) > _MAX_ENDED:
                self._ended.popitem(last=False)

    def _require_session(self, agent_id: str, session_id: str) -> None:
        if session_id in self._ended:
            raise SessionUnknownError(f"session of agent {quote_name(agent_id)}: it has ended; join again")

    def _require_joined(self, agent_id: str) -> None:
        if agent_id not in self._session_of and agent_id in self._ended.values():
            raise SessionUnknownError(f"agent {quote_name(agent_id)}: its session has ended; join again")
