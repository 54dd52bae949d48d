"""Find which voxels of the agent's map changed since a revision, and read them for the streams of WatchMap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from gausslite.codec.subset_codec import split_batch
from gausslite.domain.errors import RevisionGoneError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.revision_log import RevisionLog
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxel_operations import (
    VoxelIndex,
    crop_to_box,
    empty_batch,
    merge_batches,
    select_keys,
    tombstones,
)
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.wire.map_changes import BLOCK_BYTES, EncodedPart, EncodedPartCache, Parts, encode_parts


@dataclass(frozen=True, slots=True, eq=False)
class MapChanges:
    """The voxels that lead from a revision (0: nothing) to another one, of the whole map or of the task's region."""

    roi_only: bool
    since_revision: int
    revision: int
    batch: VoxelBatch


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

    def since(self, revision: int) -> MapChanges:
        """Return updates of all voxels that changed after this revision; the whole map for 0.

        Raises RevisionGoneError.
        """
        return MapChanges(self._roi_only, revision, self.revision, self._batch_since(revision))

    def _batch_since(self, revision: int) -> VoxelBatch:
        if revision == 0:
            return self._batch
        if self._log is None:
            raise RevisionGoneError(f"since_revision: expected 0 before the first revision, got {revision}")
        keys = self._log.changed_since(revision)
        present = select_keys(self._batch, keys)
        return merge_batches(present, tombstones(np.setdiff1d(keys, present.keys)))


@dataclass(frozen=True, slots=True, eq=False)
class AgentMapReader:
    """Reads the part of changes in a region for one watcher. The cache is that of all watchers."""

    changed: MapChanges
    region: AxisAlignedBox | None
    grid: VoxelGrid
    agent_id: str
    cache: EncodedPartCache

    def snapshot(self) -> tuple[int, Parts]:
        """Return the revision of the changes and, in parts, their voxels: the whole map."""
        return self.changed.revision, self._parts()

    def changes(self, since_revision: int) -> tuple[int, Parts]:
        """Return the revision of the changes and, in parts, their voxels; none if the watcher has this revision."""
        is_current = since_revision == self.changed.revision
        return self.changed.revision, () if is_current else self._parts()

    def _parts(self) -> Iterator[tuple[EncodedPart, ...]]:
        changed, batch = self.changed, self.changed.batch
        if self.region is not None:
            batch = crop_to_box(batch, self.region, self.grid)
        key = changed.roi_only, self.region, changed.since_revision, changed.revision
        for number, part in enumerate(split_batch(batch, BLOCK_BYTES)):
            yield self.cache.get((*key, number), partial(encode_parts, part, self.grid, self.agent_id))
