"""Fuse complete maps from files, with the same vote as the fusion server."""

from __future__ import annotations

from collections.abc import Mapping

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.vote import FusedMap, fuse


def fuse_maps(maps: Mapping[str, Gaussians], grid: VoxelGrid) -> FusedMap:
    """Return the voxel vote over complete maps by agent id (Sec. III-E).

    Raises InvalidInputError if a mean is outside the grid.
    """
    return fuse({agent_id: group_by_voxel(gaussians, grid) for agent_id, gaussians in maps.items()})
