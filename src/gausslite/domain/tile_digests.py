"""Digests of an agent's updates by spatial tile, so that agent and server find the tiles that differ."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt64
from numpy import ndarray

from gausslite.domain.column_hash import hash_columns
from gausslite.domain.voxels import tiles_of


@dataclass(frozen=True, slots=True, eq=False)
class TileDigests:
    """For each tile of 16 x 16 x 16 voxels the sum, modulo 2^64, of the hashes of its (voxel key, update_seq).

    tiles are ascending; tile_of names them.
    """

    tiles: Int64[ndarray, " t"]
    hashes: UInt64[ndarray, " t"]

    @classmethod
    def of(cls, keys: Int64[ndarray, " k"], update_seqs: Int64[ndarray, " k"]) -> TileDigests:
        """Return the digests of these updates, in any order."""
        return _sum_by_tile(tiles_of(keys), hash_columns(keys, update_seqs))

    @classmethod
    def sum_of(cls, parts: Iterable[TileDigests]) -> TileDigests:
        """Return the digests of the updates of all parts, which share no voxel."""
        each = [(part.tiles, part.hashes) for part in parts] or [(np.zeros(0, np.int64), np.zeros(0, np.uint64))]
        return _sum_by_tile(np.concatenate([tiles for tiles, _ in each]), np.concatenate([own for _, own in each]))

    def differing(self, other: TileDigests) -> Int64[ndarray, " d"]:
        """Return the tiles of these digests that `other` does not have, or has with another hash."""
        _, own, theirs = np.intersect1d(self.tiles, other.tiles, assume_unique=True, return_indices=True)
        differs = np.ones(len(self.tiles), np.bool_)
        differs[own] = self.hashes[own] != other.hashes[theirs]
        return self.tiles[differs]


def _sum_by_tile(tiles: Int64[ndarray, " k"], hashes: UInt64[ndarray, " k"]) -> TileDigests:
    names, index = np.unique(tiles, return_inverse=True)
    sums = np.zeros(len(names), np.uint64)
    np.add.at(sums, index.reshape(-1), hashes)
    return TileDigests(names, sums)
