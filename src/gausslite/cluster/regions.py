"""Assign voxels and keyframes to the shards of a store."""

from __future__ import annotations

import zlib

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.column_hash import hash_columns
from gausslite.domain.voxels import tiles_of


def shard_of_voxels(keys: Int64[ndarray, " k"], shards: int) -> Int64[ndarray, " k"]:
    """Return the shard of each voxel. Those of a tile share one; the hash spreads the tiles of a room evenly."""
    of_voxels: Int64[ndarray, " k"] = (hash_columns(tiles_of(keys)) % np.uint64(shards)).astype(np.int64)
    return of_voxels


def shard_of_keyframe(agent_id: str, index: int, shards: int) -> int:
    """Return the shard of a keyframe; the keyframes of an agent are spread over all."""
    return zlib.crc32(f"{agent_id}\0{index}".encode()) % shards
