"""Know which voxels of a map changed since when, so that a watcher gets a snapshot once and then only changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import empty_batch, group_by_voxel, merge_batches, select_keys, tombstones
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import RevisionGoneError
from gausslite.mapping.sent_voxels import SentVoxelTracker


class MapChangeLog:
    """The map's latest words and the revision at which each voxel last changed. Begins with its first update."""

    def __init__(self, grid: VoxelGrid, roi_only: bool) -> None:
        self._grid = grid
        self._roi_only = roi_only
        self._ledger = SentVoxelTracker(grid)
        self._words = empty_batch()
        self._changed_at: dict[int, int] = {}
        self._first_revision: int | None = None
        self.revision = 0

    def update(self, gaussians: Gaussians, revision: int) -> None:
        """Take in the map as it is at this revision."""
        if self._first_revision is not None and revision <= self.revision:
            return
        shown = gaussians.take(gaussians.active) if self._roi_only else gaussians
        self._words = group_by_voxel(shown, self._grid)
        # the ledger compares active Gaussians only
        changed = self._ledger.collect_changes(replace(shown, active=np.ones(len(shown), np.bool_)))
        self._changed_at.update(dict.fromkeys(changed.keys.tolist(), revision))
        self.revision = revision
        if self._first_revision is None:
            self._first_revision = revision

    def since(self, revision: int) -> VoxelBatch:
        """Words on every voxel that changed after this revision; 0 asks for the whole map. Raises RevisionGoneError."""
        if revision == 0:
            return self._words
        first = self._first_revision
        if first is None or not first <= revision <= self.revision:
            raise RevisionGoneError(
                f"since_revision: expected {first} to {self.revision}, got {revision}; watch from 0"
            )
        keys = np.array(sorted(key for key, at in self._changed_at.items() if at > revision), np.int64)
        present = select_keys(self._words, keys)
        return merge_batches(present, tombstones(np.setdiff1d(keys, present.keys)))
