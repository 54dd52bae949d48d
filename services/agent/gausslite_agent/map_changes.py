"""Find which voxels of the agent's map changed since a revision, for the streams of WatchMap."""

from __future__ import annotations

import numpy as np

from gausslite.domain.errors import RevisionGoneError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.revision_log import RevisionLog
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxel_operations import VoxelIndex, empty_batch, merge_batches, select_keys, tombstones
from gausslite.domain.voxels import VoxelGrid


class MapChangeLog:
    """The map's voxels at its latest revision, and the revision at which each last changed. Not thread-safe."""

    def __init__(self, grid: VoxelGrid, roi_only: bool) -> None:
        self._grid = grid
        self._roi_only = roi_only
        self._tracker = VoxelChangeTracker()
        self._log: RevisionLog | None = None
        self._batch = empty_batch()

    @property
    def revision(self) -> int:
        """The revision of the last update; 0 before the first."""
        return 0 if self._log is None else self._log.revision

    def update(self, gaussians: Gaussians, revision: int) -> None:
        """Compare the map with its last update; a revision that is not newer changes nothing."""
        if self._log is not None and revision <= self._log.revision:
            return
        shown = gaussians.take(gaussians.active) if self._roi_only else gaussians
        voxels = VoxelIndex.from_points(shown.means_m, self._grid)
        signatures = VoxelSignatures.from_gaussians(shown, voxels)
        changed, removed = self._tracker.update(signatures)
        counts = voxels.counts.astype(np.uint32)
        self._batch = VoxelBatch(voxels.keys, signatures.kappa_sums.copy(), counts, shown.take(voxels.rows))
        if self._log is None:
            self._log = RevisionLog(revision)
        self._log.record(signatures.keys[changed].tolist(), removed.tolist(), revision)

    def since(self, revision: int) -> VoxelBatch:
        """Return updates of all voxels that changed after this revision; the whole map for 0.

        Raises RevisionGoneError.
        """
        if revision == 0:
            return self._batch
        if self._log is None:
            raise RevisionGoneError(f"since_revision: expected 0 before the first revision, got {revision}")
        keys = self._log.changed_since(revision)
        present = select_keys(self._batch, keys)
        return merge_batches(present, tombstones(np.setdiff1d(keys, present.keys)))
