"""Choose which voxels leave the robot: in the task's region, and changed since they were sent."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxel_operations import VoxelIndex, merge_batches, select_voxels, tombstones
from gausslite.domain.voxels import VoxelGrid


class SentVoxelTracker:
    """Tracks the voxels sent to the fusion server; voxels of an earlier task's region are frozen.

    A frozen voxel keeps the Gaussians that were sent, even if the map loses them. It is sent again only if the voxel
    holds a region again and its Σkappa reaches the value that was sent.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._tracker = VoxelChangeTracker()
        self._frozen = np.zeros(0, np.int64)

    def collect_changes(self, gaussians: Gaussians) -> VoxelBatch:
        """Return updates of the voxels whose active Gaussians are new or changed since the last call.

        A voxel that has lost all active Gaussians gets a tombstone (count 0), unless it is frozen.
        """
        active = gaussians if gaussians.active.all() else gaussians.take(gaussians.active)
        voxels = VoxelIndex.from_points(active.means_m, self._grid)
        signatures = VoxelSignatures.from_gaussians(active, voxels)
        selected = self._may_replace(signatures)
        current = signatures.select(selected)
        changed = np.zeros(len(signatures.keys), np.bool_)
        changed[selected], removed = self._tracker.update(current, retained=self._frozen)
        self._frozen = np.setdiff1d(self._frozen, current.keys, assume_unique=True)
        counts = voxels.counts[changed].astype(np.uint32)
        rows = voxels.rows_in(changed)
        batch = VoxelBatch(signatures.keys[changed], signatures.kappa_sums[changed], counts, active.take(rows))
        return merge_batches(batch, tombstones(removed)) if len(removed) else batch

    def freeze_sent(self) -> None:
        """Freeze all voxels sent so far; call it when the task changes."""
        self._frozen = self._tracker.signatures.keys

    def mark_received(self, received: VoxelBatch) -> None:
        """Note voxels that were inserted from the fused map: the server has them from the agent that trained them.

        A voxel is sent only after this agent's training has raised its Σkappa by a quarter.
        """
        values = np.zeros((len(received), 3), np.uint64)
        values[:, 0] = received.kappa_sums + received.kappa_sums // np.uint64(4) + np.uint64(1)
        self._tracker.insert(VoxelSignatures(received.keys, values))
        self._frozen = np.union1d(self._frozen, received.keys)

    def exclude_frozen(self, batch: VoxelBatch) -> VoxelBatch:
        """Return the batch without the voxels that are frozen with a higher Σkappa."""
        values = np.zeros((len(batch), 3), np.uint64)
        values[:, 0] = batch.kappa_sums
        return select_voxels(batch, self._may_replace(VoxelSignatures(batch.keys, values)))

    def add_tombstones(self, batch: VoxelBatch, stored: Int64[ndarray, " s"]) -> VoxelBatch:
        """Return the batch, with a tombstone for each stored voxel that is neither in the batch nor frozen."""
        return merge_batches(batch, tombstones(np.setdiff1d(stored, np.union1d(batch.keys, self._frozen))))

    def state(self) -> State:
        """Return what later calls depend on."""
        return {**self._tracker.state(), "frozen": np.isin(self._tracker.signatures.keys, self._frozen)}

    def restore(self, state: State) -> None:
        """Continue from the state of another tracker. Raises MapFileError, ShapeError."""
        self._tracker.restore(state)
        keys = self._tracker.signatures.keys
        self._frozen = keys[get_array(state, "frozen", (len(keys),), np.bool_)]

    def _may_replace(self, candidates: VoxelSignatures) -> Bool[ndarray, " v"]:
        """True for voxels that are not frozen, or frozen with a Σkappa that is not higher."""
        if len(self._frozen) == 0:
            return np.ones(len(candidates.keys), np.bool_)
        sent = self._tracker.signatures
        frozen = sent.select(np.isin(sent.keys, self._frozen, assume_unique=True))
        place = np.minimum(np.searchsorted(frozen.keys, candidates.keys), len(frozen.keys) - 1)
        is_other = frozen.keys[place] != candidates.keys
        allowed: Bool[ndarray, " v"] = is_other | (candidates.kappa_sums >= frozen.kappa_sums[place])
        return allowed
