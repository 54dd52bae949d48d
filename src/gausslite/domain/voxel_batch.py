"""Voxel updates: the complete current Gaussians of some voxels, and the message that carries those of one agent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt32, UInt64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class VoxelBatch:
    """The complete content of each listed voxel.

    keys are strictly ascending; gaussians are sorted by voxel, counts[i] of them in keys[i]. A count of 0 is a
    tombstone (the voxel is empty now). kappa_sums are TOTALS of the voxel, never increments, so that an update may
    arrive twice or out of order.
    """

    keys: Int64[ndarray, " v"]
    kappa_sums: UInt64[ndarray, " v"]
    counts: UInt32[ndarray, " v"]
    gaussians: Gaussians

    def __post_init__(self) -> None:
        v = len(self.keys)
        require_array("voxel batch keys", self.keys, (v,), np.int64)
        require_array("voxel batch kappa_sums", self.kappa_sums, (v,), np.uint64)
        require_array("voxel batch counts", self.counts, (v,), np.uint32)
        if v > 1 and not (np.diff(self.keys) > 0).all():
            raise InvalidInputError("voxel batch keys: expected strictly ascending voxel keys")
        total = int(self.counts.sum(dtype=np.int64))
        if total != len(self.gaussians):
            raise InvalidInputError(
                f"voxel batch counts: expected a sum of {len(self.gaussians)} (the Gaussians present), got {total}"
            )

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def offsets(self) -> Int64[ndarray, " v1"]:
        """gaussians[offsets[i] : offsets[i + 1]] belong to keys[i]."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts, dtype=np.int64)])


@dataclass(frozen=True, slots=True, eq=False)
class RoiSubset:
    """One message of an agent: its updates of some voxels.

    update_seq: sequence number of these updates; in each voxel, the update with the highest one is the latest.
    message_seq: number of the message in its session, for cumulative acknowledgements.
    """

    agent_id: str
    session_id: str
    message_seq: int
    update_seq: int
    batch: VoxelBatch

    def __post_init__(self) -> None:
        if not self.agent_id:
            raise InvalidInputError("subset agent_id: expected a name, got an empty string")
        if self.message_seq < 0 or self.update_seq < 0:
            raise InvalidInputError(
                f"subset message_seq and update_seq: expected at least 0, got {self.message_seq} and {self.update_seq}"
            )
