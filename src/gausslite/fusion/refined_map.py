"""The refined map, in which voxels that changed after the start of the refinement have the newer vote's Gaussians."""

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

    batch: VoxelBatch
    revision: int

    def replace_changed(self, newer: FusedMap, changed: Int64[ndarray, " c"]) -> VoxelBatch:
        """Return the refined voxels, with the newer vote in place of the voxels in `changed`."""
        kept = select_voxels(self.batch, ~np.isin(self.batch.keys, changed))
        return merge_batches(kept, newer.batch)
