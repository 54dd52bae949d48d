"""Tell a watcher what changed in the fused map, and whose Gaussians it now shows where."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import crop_to_box, merge_batches, tombstones
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.fusion.engine import Changes
from gausslite.fusion.vote import VoteResult
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance
from gausslite.wire.map_blocks import map_blocks

_TEAM = "team"
"""The speaker of fused words; an agent of this name loses nothing, since provenance names agents."""


def change_blocks(changes: Changes, grid: VoxelGrid, region: AxisAlignedBox | None) -> Iterator[MapBlock]:
    """The blocks of a change, or of the part of it in a region; at least one."""
    words = merge_batches(changes.fused.words, tombstones(changes.vanished))
    if region is not None:
        words = crop_to_box(words, region, grid)
    election = changes.fused.election
    return map_blocks(words, grid, _TEAM, changes.revision, changes.snapshot, lambda part: _provenance(part, election))


def _provenance(part: VoxelBatch, election: VoteResult) -> Provenance:
    winner = np.zeros(len(part), np.int32)
    held = np.isin(part.keys, election.keys)
    winner[held] = election.winner[np.searchsorted(election.keys, part.keys[held])]
    return Provenance(agent_ids=election.agents, winner=winner.tolist())
