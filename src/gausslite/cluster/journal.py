"""Keep the latest writes of a shard in memory, for the servers that follow them."""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass

import numpy as np

from gausslite.cluster.store_calls import StoreCall
from gausslite.domain.errors import StorageError
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.fusion import storage_probe
from gausslite.fusion.score_index import scores_of
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
from gausslite.fusion.store_values import PutOutcome

_BUDGET_BYTES = 64 << 20
_ANSWER_BYTES = 4 << 20


class JournalGapError(StorageError):
    """The journal no longer has, or never had, the writes after a position."""


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """The changes of one transaction. transactions: the shard's number after it. origin: the server that wrote it."""

    transactions: int
    origin: str
    changes: tuple[StoreChange, ...]

    @property
    def size_bytes(self) -> int:
        """The approximate size in memory."""
        return 200 + sum(_size_bytes(change) for change in self.changes)


class Journal:
    """The entries of consecutive transactions, the latest within a number of bytes. Not thread-safe.

    start: the number of transactions before the first entry.
    """

    def __init__(self, start: int, budget_bytes: int = _BUDGET_BYTES) -> None:
        self._end, self._budget_bytes = start, budget_bytes
        self._entries: deque[JournalEntry] = deque()
        self._held_bytes = 0

    def record(self, entry: JournalEntry) -> None:
        """Append the entry of the next transaction; the oldest ones beyond the budget are dropped."""
        self._entries.append(entry)
        self._end = entry.transactions
        self._held_bytes += entry.size_bytes
        while self._held_bytes > self._budget_bytes:
            self._held_bytes -= self._entries.popleft().size_bytes

    def after(self, transactions: int) -> tuple[JournalEntry, ...]:
        """Return the first entries after this number of transactions, at least one unless there are none.

        Raises JournalGapError if an entry in between is not here.
        """
        start = self._end - len(self._entries)
        if not start <= transactions <= self._end:
            raise JournalGapError(f"journal: expected a position from {start} to {self._end}, got {transactions}")
        selected: list[JournalEntry] = []
        size_bytes = 0
        for entry in itertools.islice(self._entries, transactions - start, None):
            if selected and size_bytes + entry.size_bytes > _ANSWER_BYTES:
                break
            selected.append(entry)
            size_bytes += entry.size_bytes
        return tuple(selected)


def changes_of(call: StoreCall, result: object) -> tuple[StoreChange, ...]:
    """Return what a write has changed, from its arguments and its result."""
    match call.method, call.arguments:
        case "put_all", (subsets,):
            assert isinstance(result, list)
            return tuple(_stored(subset, outcome) for subset, outcome in zip(subsets, result, strict=True))
        case "remove_agent", (agent_id,):
            assert isinstance(result, np.ndarray)
            return (AgentRemoved(agent_id, result),)
        case "save_record", (_, storage_probe.RECORD, _):
            # every server writes this large record often, and none reads it
            return ()
        case "save_record", (agent_id, name, data):
            return (RecordSaved(agent_id, name, data),)
        case "save_keyframe", (agent_id, index, data):
            return (KeyframeSaved(agent_id, index, len(data)),)
        case "remove_keyframes", (agent_id, indices):
            return (KeyframesRemoved(agent_id, tuple(indices)),)
        case "save_session", (session,):
            return (SessionSaved(session),)
        case "end_session", (session_id,):
            return (SessionEnded(session_id),)
        case "set_mission_config", (mission_config,):
            return (MissionConfigSet(mission_config),)
    raise ValueError(f"store call: expected a write, got {call.method!r}")


def _stored(subset: RoiSubset, outcome: PutOutcome) -> UpdatesStored:
    accepted = np.isin(subset.batch.keys, outcome.accepted)
    return UpdatesStored(subset.agent_id, subset.batch.keys[accepted], scores_of(subset, accepted))


def _size_bytes(change: StoreChange) -> int:
    match change:
        case UpdatesStored() | AgentRemoved():
            return 400 + 32 * len(change.keys)
        case RecordSaved():
            return 200 + len(change.data)
        case KeyframesRemoved():
            return 200 + 8 * len(change.indices)
    return 200
