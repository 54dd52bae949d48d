"""Find the large connected parts of a surface: masks that spill over leave small parts apart from the object."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.voxels import VoxelGrid

_CELL_GRID: Final = VoxelGrid(0.05)
_MIN_PART_SHARE: Final = 0.2


def is_in_large_part(points_m: Float32[ndarray, "n 3"], weights: Int64[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return True for the points of the part with the largest weight, and of parts with a fifth of that weight.

    Points are connected if their cells of 5 cm touch.
    """
    if len(points_m) == 0:
        return np.zeros(0, np.bool_)
    keys, cell = np.unique(_CELL_GRID.keys(points_m), return_inverse=True)
    part = _parts(keys)
    totals = np.bincount(part, weights=np.bincount(cell, weights=weights))
    is_large: Bool[ndarray, " n"] = (totals >= _MIN_PART_SHARE * totals.max())[part[cell]]
    return is_large


def _parts(keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the number of the connected part of each cell: the smallest row spreads until nothing changes."""
    neighbours = keys[:, None] + NEIGHBOUR_OFFSETS
    position = np.minimum(np.searchsorted(keys, neighbours), len(keys) - 1)
    own = np.arange(len(keys))[:, None]
    rows = np.where(keys[position] == neighbours, position, own)
    part = np.arange(len(keys))
    while True:
        spread = part[rows].min(axis=1)
        spread = spread[spread]
        if np.array_equal(spread, part):
            return np.unique(part, return_inverse=True)[1]
        part = spread


def _neighbour_offsets() -> Int64[ndarray, " 27"]:
    """Return the differences of a voxel's key to those of its 26 neighbours and its own."""
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
    centre = np.full((1, 3), 0.5)
    offsets: Int64[ndarray, " 27"] = _keys(centre + steps) - _keys(centre)
    return offsets


def _keys(voxels: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    return VoxelGrid(1.0).keys(voxels.astype(np.float32))


NEIGHBOUR_OFFSETS: Final = _neighbour_offsets()
