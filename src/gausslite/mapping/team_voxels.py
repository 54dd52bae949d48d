"""Insert voxels that a teammate trained into the local map, by the rule of the fusion vote."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import VoxelIndex, select_voxels
from gausslite.domain.voxels import VoxelGrid
from gausslite.optimize.splat_table import SplatTable


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
    wins = (received.counts > 0) & (received.kappa_sums > local_sums)
    chosen = select_voxels(received, wins & _fits(received, wins, local_counts, table.free_slots))
    replaced = np.isin(local.keys, chosen.keys)
    rows = local.rows_in(replaced)
    if len(rows):
        keep = np.ones(table.count, np.bool_)
        keep[rows] = False
        table.keep(keep)
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
    if len(keys) == 0:
        return np.zeros(len(wanted), values.dtype)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[place] == wanted, values[place], values.dtype.type(0))
