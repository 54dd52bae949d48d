"""What other servers have changed in a store that several of them share."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Int64
from numpy import ndarray

from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store_values import SessionRecord, StoredScores


@dataclass(frozen=True, slots=True, eq=False)
class UpdatesStored:
    """Voxels of an agent with a new update (keys in ascending order), and the totals of these updates.

    is_own: this server has written them.
    """

    agent_id: str
    keys: Int64[ndarray, " k"]
    scores: StoredScores
    is_own: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class AgentRemoved:
    """Data of an agent was deleted: updates (keys: their voxels, ascending), keyframes and records.

    has_records: false for a part of the store that has no records.
    """

    agent_id: str
    keys: Int64[ndarray, " k"]
    has_records: bool = True


@dataclass(frozen=True, slots=True)
class RecordSaved:
    """A named record of an agent has new content; an empty agent_id for one of the mission."""

    agent_id: str
    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class KeyframeSaved:
    """An agent's keyframe of this frame index was stored."""

    agent_id: str
    index: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class KeyframesRemoved:
    """An agent's keyframes of these frame indices were deleted."""

    agent_id: str
    indices: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SessionSaved:
    """An agent has joined; its earlier session has ended."""

    session: SessionRecord


@dataclass(frozen=True, slots=True)
class SessionEnded:
    """A session has ended without a new one."""

    session_id: str


@dataclass(frozen=True, slots=True)
class MissionConfigSet:
    """The agents have agreed on a configuration."""

    mission_config: MissionConfig


@dataclass(frozen=True, slots=True)
class ContentReplaced:
    """Changes were missed. The totals were read again; who holds anything else of the store has to do the same."""


StoreChange = (
    UpdatesStored
    | AgentRemoved
    | RecordSaved
    | KeyframeSaved
    | KeyframesRemoved
    | SessionSaved
    | SessionEnded
    | MissionConfigSet
    | ContentReplaced
)
