"""What a joint refinement begins with: the vote, and the team's keyframes in its frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import AgentKeyframe


@dataclass(frozen=True, slots=True, eq=False)
class RefineInput:
    """The vote at a revision, and the team's keyframes in its frame.

    regions: the voxels of its task's region that each agent wins; agents that win others only have an entry without.
    """

    gaussians: Gaussians
    keyframes: Sequence[AgentKeyframe]
    regions: Mapping[str, Int64[ndarray, " k"]]
    grid: VoxelGrid
    revision: int

    @classmethod
    def of(cls, engine: FusionEngine) -> RefineInput:
        """Return an engine's fused map and all agents' keyframes. Raises MismatchError if one is empty."""
        # before the map is read: what changes meanwhile counts as changed
        revision, (voted, regions) = engine.maps.revision(), engine.maps.voted_regions()
        encoded = engine.keyframes.read(engine.keyframes.names())
        if not encoded or len(voted.gaussians) == 0:
            raise MismatchError(
                f"refinement: expected a fused map and keyframes, got {len(voted.gaussians)} Gaussians and "
                f"{len(encoded)} keyframes; agents send keyframes with handover = true"
            )
        keyframes = engine.in_fused_frame(engine.keyframes.decode(encoded))
        return cls(voted.gaussians, keyframes, regions, engine.grid, revision)
