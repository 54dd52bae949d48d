"""What the agents observed as free: evidence about the frames of agents whose maps do not overlap."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.codec.free_space import MAX_BLOCKS, decode_free_space, encode_free_space
from gausslite.domain.errors import QuotaError
from gausslite.domain.free_space import FreeSpace
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.store import FusionStore

RECORD = "free_space"
_STORED_BYTES = 1 << 23
MIN_VIEWS = 2
"""Views of one agent that have to agree: one view may have a wrong depth or pose."""


class FreeSpaceRecords:
    """Each agent's free space, in the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore, grid: VoxelGrid) -> None:
        self._store, self.grid = store, grid
        stored = store.records(RECORD).items()
        self._by_agent = {agent_id: decode_free_space(data, _STORED_BYTES)[0] for agent_id, data in stored}

    def contribute(self, agent_id: str, blocks: FreeSpace) -> None:
        """Replace these blocks of an agent. Raises QuotaError, InvalidInputError for blocks out of the grid's range."""
        blocks.require_within(self.grid)
        after = self._by_agent.get(agent_id, FreeSpace.empty()).replace_blocks(blocks)
        if len(after.keys) > MAX_BLOCKS:
            raise QuotaError(f"free space: expected at most {MAX_BLOCKS} blocks of an agent, got {len(after.keys)}")
        self._store.save_record(agent_id, RECORD, encode_free_space(after, self.grid))
        self._by_agent[agent_id] = after

    def free_voxels(self, agent_id: str) -> int:
        """Return the number of voxels that the agent has observed as free."""
        return self._by_agent.get(agent_id, FreeSpace.empty()).free_voxels

    def seen_by(self, agents: Collection[str], keys: Int64[ndarray, " k"]) -> Bool[ndarray, " k"]:
        """Return True for the voxels that one of these agents has observed as free in two views."""
        seen = np.zeros(len(keys), np.bool_)
        for agent_id in self._by_agent.keys() & set(agents):
            seen |= self._by_agent[agent_id].views(keys, self.grid) >= MIN_VIEWS
        return seen

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent; the store deletes its record with its updates."""
        self._by_agent.pop(agent_id, None)
