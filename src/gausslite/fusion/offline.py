"""Fuse complete maps without a server, by the same per-voxel vote."""

from __future__ import annotations

from collections.abc import Mapping

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.vote import FusedMap, fuse


def fuse_maps(maps: Mapping[str, Gaussians], grid: VoxelGrid) -> FusedMap:
    """Return the fused map: each voxel holds the Gaussians of the agent with the highest Σkappa there (Sec. III-E).

    maps: the complete map of each agent id.
    Raises InvalidInputError if a mean is outside the grid.
    """
    return fuse({agent_id: group_by_voxel(gaussians, grid) for agent_id, gaussians in maps.items()})
