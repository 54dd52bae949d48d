"""What decides the frames of a team's agents: a component that gets copies, holds no lock and returns decisions.

An aligner is a plug-in of the group gausslite.aligners. Without one, frames are used as the agents declare them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.keyframe_pool import KeyframePool
from gausslite.fusion.score_index import AgentTotals
from gausslite.fusion.store import FusionStore


class TeamView:
    """The team as an aligner sees it: the agents' frames at one instant, and copies of their newest data.

    Reading waits for no commit and holds no lock of the engine.
    """

    def __init__(
        self, frames: Mapping[str, tuple[int, FrameAlignment]], store: FusionStore, keyframes: KeyframePool
    ) -> None:
        self.frames = frames
        """By rank: the id of each agent's frame, and its alignment."""
        self._store, self._keyframes = store, keyframes

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over the agent's updates."""
        return self._store.totals(agent_id)

    def keys(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Return the agent's voxels (with tombstones), ascending."""
        return self._store.keys(agent_id)

    def voxels(self, agent_id: str, keys: Int64[ndarray, " k"]) -> tuple[VoxelBatch, Int64[ndarray, " v"]]:
        """Return the agent's updates of these voxels, and their sequence numbers. Raises StorageError."""
        batch = self._store.batch(agent_id, keys)
        return batch, self._store.scores_of(agent_id, batch.keys)["update_seqs"]

    def keyframe_ids(self, agent_id: str) -> dict[int, int]:
        """Return the id of the agent's keyframe of each index; one that is received again has another id."""
        return self._keyframes.ids(agent_id)

    def keyframe(self, agent_id: str, index: int) -> Frame | None:
        """Return a keyframe; None if it is gone. Raises CodecError for a damaged one, StorageError."""
        found = self._keyframes.decode(self._keyframes.read([(agent_id, index)]))
        return found[0].frame if found else None


@dataclass(frozen=True, slots=True)
class FrameDecisions:
    """What an aligner has decided for the frames of a TeamView."""

    alignments: Mapping[str, FrameAlignment] = field(default_factory=dict)
    """The agents whose alignment is another one now."""
    deleted: tuple[str, ...] = ()
    """Former maps that their agents' newer ones contradict."""
    is_due: bool = False
    """Whether more agents wait for a comparison."""
    failure: str = ""
    """Why an agent could not be compared; it is due again."""


class FrameAligner(Protocol):
    """Compares the agents' maps, corrects their frames, finds unknown ones and quarantines what contradicts others.

    `observe` and `forget` return at once, in any thread. `poll` takes seconds; call it from one thread at a time.
    """

    def observe(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Note that these voxels of an agent have changed."""

    def forget(self, agent_id: str) -> None:
        """Note that the agent's data are deleted."""

    def poll(self, team: TeamView, at_most: int | None = None) -> FrameDecisions:
        """Compare the agents with enough new data, and return what follows. Raises StorageError.

        at_most: number of agents to compare, those first whose latest comparison is the oldest.
        """

    def close(self) -> None:
        """End the comparison that runs, if any, and its process."""
