"""Name the calls of a store that travel between processes, and what travels with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

WRITES = frozenset(
    {
        "put_all",
        "remove_agent",
        "set_mission_config",
        "save_session",
        "end_session",
        "save_keyframe",
        "remove_keyframes",
        "save_record",
    }
)
READS = frozenset(
    {
        "incarnation_id",
        "agents",
        "totals",
        "digests",
        "stored",
        "scores",
        "batch",
        "batches",
        "mission_config",
        "sessions",
        "keyframe_sizes",
        "keyframe",
        "records",
    }
)
JOURNAL = "journal_after"
"""Returns the JournalEntries after a number of transactions; a call of a replica, not of its store."""


@dataclass(frozen=True, slots=True)
class StoreCall:
    """A method of FusionStore and its arguments, in their order. origin: the server that calls."""

    method: str
    arguments: tuple[Any, ...] = ()
    origin: str = ""


@dataclass(frozen=True, slots=True)
class LogPosition:
    """The state of a shard: the epoch, which grows with each new primary, and the number of transactions."""

    epoch: int
    transactions: int


@dataclass(frozen=True, slots=True)
class LogEntry:
    """A write of the primary. position: that of the shard before it."""

    position: LogPosition
    call: StoreCall


@dataclass(frozen=True, slots=True)
class StoreReply:
    """The result of a call, and the position of the shard after it."""

    result: Any
    position: LogPosition
