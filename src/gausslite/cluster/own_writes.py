"""Decide which writes in the journal of a shard are news to the server that reads it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

from gausslite.cluster.store_calls import StoreCall
from gausslite.fusion.store_changes import (
    AgentRemoved,
    KeyframeSaved,
    KeyframesRemoved,
    MissionConfigSet,
    RecordSaved,
    SessionEnded,
    SessionSaved,
    StoreChange,
    UpdatesStored,
)

_Subject = tuple[str, ...]
_RECORD, _KEYFRAME = "record", "keyframe"
_OF_AGENT = (_RECORD, _KEYFRAME)


class OwnWrites:
    """Counts the own writes of each thing (record, session, keyframe, agent) that the journal has not shown yet.

    A server applies its own writes at once. So a write of another server that precedes an own one of the same thing is
    outdated, and the own one is no news. Updates are compared by their sequence numbers instead, and are always news
    unless their agent is deleted later. Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._pending: Counter[_Subject] = Counter()

    @contextmanager
    def writing(self, call: StoreCall) -> Iterator[None]:
        """Count a write as pending, unless it fails."""
        subjects = list(_subjects_of_call(call))
        self._add(subjects, 1)
        try:
            yield
        except BaseException:
            self._add(subjects, -1)
            raise

    def clear(self) -> None:
        """Count no write as pending any more."""
        with self._lock:
            self._pending.clear()

    def is_news(self, change: StoreChange, is_own: bool) -> bool:
        """Return whether a change from the journal is to be applied; call it once for each, in their order."""
        subjects = list(_subjects(change))
        with self._lock:
            if is_own and not isinstance(change, UpdatesStored):
                is_pending = any(self._pending[subject] for subject in subjects)
                for subject in subjects:
                    self._count(subject, -1)
                # an own write that failed here, but was stored
                return not is_pending
            is_news = not any(self._pending[subject] for subject in [*subjects, *_agent_of(change)])
            if is_news and isinstance(change, AgentRemoved):
                # it has deleted also what was written here early; the journal has these writes after it
                for subject in [each for each in self._pending if each[0] in _OF_AGENT and each[1] == change.agent_id]:
                    del self._pending[subject]
            return is_news

    def _add(self, subjects: list[_Subject], number: int) -> None:
        with self._lock:
            for subject in subjects:
                self._count(subject, number)

    def _count(self, subject: _Subject, number: int) -> None:
        self._pending[subject] += number
        if self._pending[subject] <= 0:
            del self._pending[subject]


def _subjects_of_call(call: StoreCall) -> Iterator[_Subject]:
    match call.method, call.arguments:
        case "remove_agent", (agent_id,):
            yield ("agent", agent_id)
        case "save_record", (agent_id, name, _):
            yield (_RECORD, agent_id, name)
        case "save_keyframe", (agent_id, index, _):
            yield (_KEYFRAME, agent_id, str(index))
        case "remove_keyframes", (agent_id, indices):
            yield from ((_KEYFRAME, agent_id, str(index)) for index in indices)
        case "save_session", (session,):
            yield ("session", session.agent_id)
        case "end_session", (session_id,):
            yield ("end", session_id)
        case "set_mission_config", _:
            yield ("mission",)


def _subjects(change: StoreChange) -> Iterator[_Subject]:
    match change:
        case AgentRemoved(agent_id):
            yield ("agent", agent_id)
        case RecordSaved(agent_id, name):
            yield (_RECORD, agent_id, name)
        case KeyframeSaved(agent_id, index):
            yield (_KEYFRAME, agent_id, str(index))
        case KeyframesRemoved(agent_id, indices):
            yield from ((_KEYFRAME, agent_id, str(index)) for index in indices)
        case SessionSaved(session):
            yield ("session", session.agent_id)
        case SessionEnded(session_id):
            yield ("end", session_id)
        case MissionConfigSet():
            yield ("mission",)


def _agent_of(change: StoreChange) -> Iterator[_Subject]:
    match change:
        case UpdatesStored(agent_id) | RecordSaved(agent_id) | KeyframeSaved(agent_id) | KeyframesRemoved(agent_id):
            yield ("agent", agent_id)
