"""Voxels of a teammate in the local map: inserted by the vote's rule, with their kappa, and not sent back unchanged."""

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, group_by_voxel
from gausslite.mapping.splat_table import SplatTable
from gausslite.mapping.voxel_exchange import SentVoxelTracker, insert_team_voxels

GRID = VoxelGrid(0.10)


def in_cells(*cells: tuple[int, int]) -> Gaussians:
    """One Gaussian for each (cell along x, kappa)."""
    means = [(0.1 * cell + 0.05, 0.05, 0.05) for cell, _ in cells]
    return plain_gaussians(means, kappa=[kappa for _, kappa in cells])


def received(*cells: tuple[int, int]) -> VoxelBatch:
    return group_by_voxel(in_cells(*cells), GRID)


def table_with(gaussians: Gaussians, capacity: int = 10) -> SplatTable:
    table = SplatTable(capacity)
    table.append(gaussians)
    return table


def kappas(table: SplatTable) -> dict[int, list[int]]:
    cells = np.floor(table.means_m[:, 0] / 0.1 + 1e-4).astype(int)
    return {int(cell): sorted(table.kappa[cells == cell].tolist()) for cell in np.unique(cells)}


def test_a_voxel_with_a_higher_kappa_sum_replaces_the_local_one() -> None:
    table = table_with(in_cells((0, 5), (0, 5), (1, 1), (2, 8)))
    inserted = insert_team_voxels(table, received((0, 9), (1, 2), (1, 3), (3, 4)), GRID)
    assert kappas(table) == {0: [5, 5], 1: [2, 3], 2: [8], 3: [4]}
    assert (inserted.gaussians, inserted.replaced, len(inserted.batch)) == (3, 1, 2)


def test_only_the_best_voxels_are_inserted_if_the_table_is_full() -> None:
    table = table_with(in_cells((0, 1), (1, 1)), capacity=3)
    insert_team_voxels(table, received((5, 2), (6, 9), (7, 3)), GRID)
    assert kappas(table) == {0: [1], 1: [1], 6: [9]}


def test_an_empty_table_starts_with_the_teams_map() -> None:
    table = SplatTable(10)
    insert_team_voxels(table, received((1, 4), (2, 7)), GRID)
    assert kappas(table) == {1: [4], 2: [7]}
    assert insert_team_voxels(table, received(), GRID).gaussians == 0


def test_received_voxels_are_sent_only_after_training_them_further() -> None:
    tracker = SentVoxelTracker(GRID)
    tracker.mark_received(received((0, 8), (1, 8)))
    assert len(tracker.collect_changes(in_cells((0, 8), (1, 9)))) == 0
    changed = tracker.collect_changes(in_cells((0, 11), (1, 9), (2, 1)))
    assert changed.kappa_sums.tolist() == [11, 1]
    # a voxel that never left this robot gets no tombstone
    assert len(tracker.collect_changes(in_cells((0, 11), (2, 1)))) == 0
