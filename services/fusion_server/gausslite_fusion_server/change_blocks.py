"""Encode the changes of the fused map, with the agent that wins each voxel, as messages for a watcher."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import crop_to_box, merge_batches, tombstones
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.fusion.fused_map import FusedMapChanges
from gausslite.fusion.vote import VoteResult
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance
from gausslite.wire.map_blocks import map_blocks

_SENDER = "fusion-server"
"""The agent id inside the subset bytes of fused voxels; readers use the provenance instead."""


def change_blocks(changes: FusedMapChanges, grid: VoxelGrid, region: AxisAlignedBox | None) -> Iterator[MapBlock]:
    """Yield the blocks of the changes, or of their part in a region; at least one."""
    batch = merge_batches(changes.fused.batch, tombstones(changes.removed))
    if region is not None:
        batch = crop_to_box(batch, region, grid)
    vote = changes.fused.vote
    return map_blocks(batch, grid, _SENDER, changes.revision, changes.snapshot, lambda part: _provenance(part, vote))


def _provenance(part: VoxelBatch, vote: VoteResult) -> Provenance:
    winner = np.zeros(len(part), np.int32)
    has_winner = np.isin(part.keys, vote.keys)
    winner[has_winner] = vote.winner_index[np.searchsorted(vote.keys, part.keys[has_winner])]
    return Provenance(agent_ids=vote.agents, winner=winner.tolist())
