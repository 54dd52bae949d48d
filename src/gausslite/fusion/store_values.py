"""What stores of voxel updates take and return: the mission's configuration, sessions, outcomes and totals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int32, Int64, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.checks import quote_name, require_identifier, require_name
from gausslite.domain.errors import InvalidInputError, MismatchError

_DEFAULT_MISSION_ID, _DEFAULT_WORLD_FRAME = "mission", "world"


@dataclass(frozen=True, slots=True)
class MissionConfig:
    """Common to all voxel updates of one store; the first agent that joins fixes it. Names may be empty until then."""

    mission_id: str
    world_frame: str
    voxel_size_m: float

    def with_default_names(self) -> MissionConfig:
        """Return the configuration with "mission" and "world" in place of empty names."""
        mission_id, world_frame = self.mission_id or _DEFAULT_MISSION_ID, self.world_frame or _DEFAULT_WORLD_FRAME
        return MissionConfig(mission_id, world_frame, self.voxel_size_m)

    @property
    def given_world_frame(self) -> str:
        """The world frame's name; empty if it is the default, because maps of different frames share that name."""
        return "" if self.world_frame == _DEFAULT_WORLD_FRAME else self.world_frame


def reconcile(own: MissionConfig, requested: MissionConfig) -> MissionConfig:
    """Return the configuration that satisfies both sides; an empty name accepts the other side's.

    Raises InvalidInputError if a requested name is not permitted, MismatchError if the sides differ.
    """
    if requested.mission_id:
        require_identifier("mission_id", requested.mission_id)
    require_name("world_frame", requested.world_frame)
    if requested.voxel_size_m != own.voxel_size_m:
        raise MismatchError(
            f"voxel size: this mission votes on {own.voxel_size_m:g} m, got {requested.voxel_size_m:g} m"
        )
    for field, expected, received in (
        ("world frame", own.world_frame, requested.world_frame),
        ("mission", own.mission_id, requested.mission_id),
    ):
        if expected and received and expected != received:
            raise MismatchError(f"{field}: expected {quote_name(expected)} as agreed here, got {quote_name(received)}")
    return MissionConfig(
        own.mission_id or requested.mission_id, own.world_frame or requested.world_frame, own.voxel_size_m
    )


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """An agent's permission to contribute, from joining until it leaves or joins again."""

    session_id: str
    agent_id: str


@dataclass(frozen=True, slots=True, eq=False)
class PutOutcome:
    """The voxels of a message that were stored, and those that were stale; keys in ascending order."""

    accepted: Int64[ndarray, " a"]
    stale: Int64[ndarray, " s"]


SCORES = np.dtype([("keys", "i8"), ("update_seqs", "i8"), ("kappa_sums", "u8"), ("counts", "u4"), ("rows", "i8")])
Scores = NDArray[Any]
"""An element of SCORES for each of an agent's updates: its totals, and the store's row that has its Gaussians.

update_seq and row are -1 where the agent has no update of a voxel.
"""
NO_SCORES: Scores = np.zeros(0, SCORES)


@dataclass(frozen=True, slots=True, eq=False)
class VoxelScoreTable:
    """The totals of every update (tombstones included) without the Gaussians: the input of the vote.

    agent_index holds indices into `agents`, which is sorted; the scores are sorted by (agent, key).
    """

    agents: tuple[str, ...]
    agent_index: Int32[ndarray, " w"]
    scores: Scores

    def __len__(self) -> int:
        return len(self.scores)

    def take(self, places: Int64[ndarray, " s"]) -> VoxelScoreTable:
        """Return the scores at these places."""
        return VoxelScoreTable(self.agents, self.agent_index[places], self.scores.take(places))


@dataclass(frozen=True, slots=True)
class AgentTotals:
    """Sums over an agent's updates: voxels with and without tombstones, Gaussians, Σkappa; the highest update_seq."""

    voxels: int = 0
    occupied_voxels: int = 0
    gaussians: int = 0
    kappa_sum: int = 0
    highest_update_seq: int = 0

    def replace_part(self, removed: Scores, added: Scores) -> AgentTotals:
        """Return the totals after `added` replaced `removed`."""
        counts, counts_before = added["counts"], removed["counts"]
        return AgentTotals(
            self.voxels + len(added) - int(np.count_nonzero(removed["update_seqs"] >= 0)),
            self.occupied_voxels + int(np.count_nonzero(counts)) - int(np.count_nonzero(counts_before)),
            self.gaussians + int(counts.sum(dtype=np.int64)) - int(counts_before.sum(dtype=np.int64)),
            self.kappa_sum + _exact_sum(added["kappa_sums"]) - _exact_sum(removed["kappa_sums"]),
            max(self.highest_update_seq, int(added["update_seqs"].max(initial=0))),
        )


def _exact_sum(values: UInt64[ndarray, " k"]) -> int:
    """Return a sum that cannot wrap around."""
    return sum(values.tolist())


def require_storable(update: StoredSubset) -> None:
    """Raise InvalidInputError if a number of the message does not fit the store's signed 64-bit columns."""
    largest_sum = int(update.voxels.voxels["kappa_sums"].max(initial=0))
    limit = int(np.iinfo(np.int64).max)
    numbers = (("update_seq", update.update_seq), ("message_seq", update.message_seq), ("kappa_sum", largest_sum))
    for name, value in numbers:
        if value > limit:
            raise InvalidInputError(f"subset {name}: expected at most {limit}, got {value}")
