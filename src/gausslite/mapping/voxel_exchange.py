"""Exchange voxels with the team: send changed ones of the task's region, insert those that others trained more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64, UInt64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, VoxelIndex, find_in, merge_batches, select_voxels, tombstones
from gausslite.mapping.pager import MapPager
from gausslite.mapping.splat_table import SplatTable

_WHOLE_MAP = MapPager()


class SentVoxelTracker:
    """Tracks the voxels sent to the fusion server; voxels of an earlier task's region are frozen.

    A frozen voxel keeps the Gaussians that were sent, even if the map loses them. It is sent again only if the voxel
    holds a region again and its Σkappa reaches the value that was sent.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._tracker = VoxelChangeTracker()
        self._frozen = np.zeros(0, np.int64)

    def collect_changes(self, gaussians: Gaussians, pager: MapPager = _WHOLE_MAP) -> VoxelBatch:
        """Return updates of the voxels whose active Gaussians are new or changed since the last call.

        A voxel that has lost all active Gaussians gets a tombstone (count 0), unless it is frozen. One of which
        the pager holds a part, which is not among the Gaussians, waits for it.
        """
        active = gaussians if gaussians.active.all() else gaussians.take(gaussians.active)
        voxels = VoxelIndex.from_points(active.means_m, self._grid)
        signatures = VoxelSignatures.from_gaussians(active, voxels)
        # the server keeps what an earlier task trained better
        selected = self._may_replace(signatures.keys, signatures.kappa_sums) & ~pager.holds(signatures.keys)
        current = signatures.select(selected)
        changed = np.zeros(len(signatures.keys), np.bool_)
        sent = self._tracker.signatures.keys
        retained = np.concatenate([self._frozen, sent[pager.holds(sent)]])
        changed[selected], removed = self._tracker.update(current, retained)
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
        # a signature whose number and hash no content has: the voxel counts as changed when its Σkappa suffices
        values = np.zeros((len(received), 3), np.uint64)
        values[:, 0] = received.kappa_sums + received.kappa_sums // np.uint64(4) + np.uint64(1)
        self._tracker.insert(VoxelSignatures(received.keys, values))
        self._frozen = np.union1d(self._frozen, received.keys)

    def exclude_frozen(self, batch: VoxelBatch) -> VoxelBatch:
        """Return the batch without the voxels that are frozen with a higher Σkappa."""
        return select_voxels(batch, self._may_replace(batch.keys, batch.kappa_sums))

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

    def _may_replace(self, keys: Int64[ndarray, " v"], kappa_sums: UInt64[ndarray, " v"]) -> Bool[ndarray, " v"]:
        """True for voxels that are not frozen, or frozen with a Σkappa that is not higher."""
        sent = self._tracker.signatures
        frozen = sent.select(np.isin(sent.keys, self._frozen, assume_unique=True))
        allowed: Bool[ndarray, " v"] = kappa_sums >= _lookup(frozen.keys, frozen.kappa_sums, keys)
        return allowed


@dataclass(frozen=True, slots=True, eq=False)
class InsertedVoxels:
    """The voxels that were inserted, and the number of their Gaussians and of the local ones that they replaced."""

    batch: VoxelBatch
    replaced: int

    @property
    def gaussians(self) -> int:
        """Number of inserted Gaussians."""
        return len(self.batch.gaussians)


def insert_team_voxels(table: SplatTable, received: VoxelBatch, grid: VoxelGrid) -> InsertedVoxels:
    """Replace the local Gaussians of each voxel where the received Σkappa is higher; the Gaussians keep their kappa.

    If not all fit into the table, the voxels with the highest Σkappa are inserted. Raises InvalidInputError for means
    outside the grid's range.
    """
    local = VoxelIndex.from_points(table.means_m, grid)
    local_sums, local_counts = (
        _lookup(local.keys, values, received.keys) for values in (local.sums(table.kappa), local.counts)
    )
    # the vote of Sec. III-E, between this robot and the team
    wins = (received.counts > 0) & (received.kappa_sums > local_sums)
    chosen = select_voxels(received, wins & _fits(received, wins, local_counts, table.free_slots))
    replaced = np.isin(local.keys, chosen.keys)
    rows = local.rows_in(replaced)
    table.remove(rows)  # all of a voxel or nothing: parts of two maps do not fit
    table.append(chosen.gaussians)
    return InsertedVoxels(chosen, len(rows))


def _fits(
    received: VoxelBatch, wins: Bool[ndarray, " v"], replaced: Int64[ndarray, " v"], free_slots: int
) -> Bool[ndarray, " v"]:
    """Return True for the voxels that fit, those with the highest Σkappa first."""
    growth = np.where(wins, received.counts.astype(np.int64) - replaced, 0)
    order = np.lexsort((received.keys, ~received.kappa_sums))
    fits = np.zeros(len(received), np.bool_)
    # a prefix sum: after the first voxel that does not fit, only voxels that shrink the map could follow
    fits[order] = np.cumsum(np.maximum(growth[order], 0)) <= free_slots
    return fits


def _lookup(keys: Int64[ndarray, " l"], values: ndarray, wanted: Int64[ndarray, " v"]) -> ndarray:
    """Return the value of each wanted key; 0 for a key that is absent."""
    found: ndarray = np.append(values, values.dtype.type(0))[find_in(keys, wanted)]
    return found
