"""The refined map, laid over the vote it was made from: what agents say later shows through voxel by voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import merge_batches, select_voxels
from gausslite.fusion.vote import FusedMap


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap:
    """The result of a refinement and the fused revision it started from."""

    words: VoxelBatch
    revision: int

    def overlaid(self, newer: FusedMap, changed: Int64[ndarray, " c"]) -> VoxelBatch:
        """The refined words, except on the voxels that changed since: these show the newer vote."""
        kept = select_voxels(self.words, ~np.isin(self.words.keys, changed))
        return merge_batches(kept, newer.words)
