"""The voxel updates as the vote reads them."""

from __future__ import annotations

from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.fusion.store import FusionStore, VoxelScoreTable


class VoteInput:
    """Reads the updates from the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._store.agents()

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        return self._store.scores(keys)

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the updates of every agent on these voxels, or on all."""
        return self._store.batches(keys)
