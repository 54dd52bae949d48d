"""What decides the frames of a team's agents: a component that gets copies, holds no lock and returns decisions.

An aligner is a plug-in of the group gausslite.aligners. Without one, frames are used as the agents declare them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from jaxtyping import Int64
from numpy import ndarray

from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.keyframe_pool import KeyframePool
from gausslite.fusion.store import FusionStore


@dataclass(frozen=True, slots=True, eq=False)
class TeamView:
    """The team as an aligner sees it. Reading its newest data waits for no commit and holds no lock of the engine."""

    frames: Mapping[str, tuple[int, FrameAlignment]]  # at one instant, by rank: the id of each frame, and its alignment
    store: FusionStore
    keyframes: KeyframePool


@dataclass(frozen=True, slots=True)
class FrameDecisions:
    """What an aligner has decided for the frames of a TeamView."""

    alignments: Mapping[str, FrameAlignment] = field(default_factory=dict)  # of agents that have another one now
    deleted: tuple[str, ...] = ()  # former maps that their agents' newer ones contradict
    is_due: bool = False  # whether more agents wait for a comparison
    failure: str = ""  # why an agent could not be compared; it is due again


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
