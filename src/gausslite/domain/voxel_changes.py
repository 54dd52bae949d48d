"""Find the voxels that changed: between two states of a map, or between agent and server."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.domain.voxels import VoxelIndex, find_in, tiles_of


def hash_columns(*columns: NDArray[Any]) -> UInt64[ndarray, " n"]:
    """Return a 64-bit hash of each row of these integer columns; the same in every process and on every machine.

    Each column is mixed in with SplitMix64 (Steele et al., OOPSLA 2014). It is no protection against forgery.
    """
    hashed = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        hashed = (hashed ^ column.astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        hashed = (hashed ^ (hashed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        hashed = (hashed ^ (hashed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        hashed ^= hashed >> np.uint64(31)
    return hashed


@dataclass(frozen=True, slots=True, eq=False)
class TileDigests:
    """The sums, modulo 2^64, of the hashes of (voxel key, update_seq) in each tile; tiles (see tile_of) ascend."""

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


@dataclass(frozen=True, slots=True, eq=False)
class VoxelSignatures:
    """Σkappa, number and hash of the Gaussians of each voxel: what changes with its contents. keys are ascending."""

    keys: Int64[ndarray, " v"]
    values: UInt64[ndarray, "v 3"]

    @classmethod
    def empty(cls) -> VoxelSignatures:
        """Return the signatures of a map without Gaussians."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3), np.uint64))

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians, voxels: VoxelIndex) -> VoxelSignatures:
        """Compute the signatures of the indexed voxels. The order of the Gaussians in a voxel has no influence."""
        columns = voxels.sums(gaussians.kappa), voxels.counts.astype(np.uint64), voxels.sums(_hash_rows(gaussians))
        return cls(voxels.keys, np.stack(columns, axis=1))

    @property
    def kappa_sums(self) -> UInt64[ndarray, " v"]:
        """Σkappa of each voxel."""
        return self.values[:, 0]

    def select(self, chosen: Bool[ndarray, " v"]) -> VoxelSignatures:
        """Return the signatures of the chosen voxels."""
        return VoxelSignatures(self.keys[chosen], self.values[chosen])


class VoxelChangeTracker:
    """Owns the signature of each voxel at the last update. Not thread-safe."""

    def __init__(self) -> None:
        self.signatures = VoxelSignatures.empty()

    def update(
        self, current: VoxelSignatures, retained: Int64[ndarray, " r"] | None = None
    ) -> tuple[Bool[ndarray, " v"], Int64[ndarray, " d"]]:
        """Store the current signatures; return which voxels are new or changed, and the keys of those removed.

        A voxel in `retained` that is absent from `current` keeps its signature and does not count as removed.
        """
        changed = ~self._is_unchanged(current)
        previous = self.signatures
        absent = ~np.isin(previous.keys, current.keys, assume_unique=True)
        kept = absent & np.isin(previous.keys, retained) if retained is not None else np.zeros(len(absent), np.bool_)
        self._store(current, previous.select(kept))
        return changed, previous.keys[absent & ~kept]

    def insert(self, added: VoxelSignatures) -> None:
        """Store these signatures; they replace those of the same voxels."""
        self._store(added, self.signatures.select(~np.isin(self.signatures.keys, added.keys)))

    def state(self) -> State:
        """Return the signatures of the last update."""
        return {"keys": self.signatures.keys, "signatures": self.signatures.values}

    def restore(self, state: State) -> None:
        """Replace the signatures by those of another tracker. Raises MapFileError, ShapeError."""
        keys = get_array(state, "keys", (None,), np.int64)
        if (keys[1:] <= keys[:-1]).any():
            raise MapFileError("state keys: expected strictly ascending voxel keys, got others")
        values = get_array(state, "signatures", (len(keys), 3), np.uint64)
        self.signatures = VoxelSignatures(keys.copy(), values.copy())

    def _is_unchanged(self, current: VoxelSignatures) -> Bool[ndarray, " v"]:
        previous = self.signatures
        if len(previous.keys) == 0:
            return np.zeros(len(current.keys), np.bool_)
        place = find_in(previous.keys, current.keys)
        unchanged: Bool[ndarray, " v"] = (place >= 0) & (previous.values[place] == current.values).all(axis=1)
        return unchanged

    def _store(self, current: VoxelSignatures, kept: VoxelSignatures) -> None:
        keys = np.concatenate([current.keys, kept.keys])
        order = np.argsort(keys, kind="stable")
        self.signatures = VoxelSignatures(keys[order], np.concatenate([current.values, kept.values])[order])


def _hash_rows(gaussians: Gaussians) -> UInt64[ndarray, " n"]:
    """Return a hash of each Gaussian's values; the hash of a voxel is their sum."""
    g = gaussians
    columns = [*g.means_m.T, *g.quats_wxyz.T, *g.scales_m.T, g.opacities, *g.rgb.T]
    # odd multipliers from a fixed seed: equal Gaussians have equal hashes in every run
    multipliers = np.random.default_rng(0).integers(0, 2**64, len(columns), np.uint64) | np.uint64(1)
    total = g.target.astype(np.uint64)
    product = np.empty_like(total)
    # column by column, so that the sum stays in the cache
    for column, multiplier in zip(columns, multipliers, strict=True):
        total += np.multiply(column.view(np.uint32), multiplier, out=product)
    return _mix(total)


def _mix(values: UInt64[ndarray, " n"]) -> UInt64[ndarray, " n"]:
    # the sums alone are linear: two voxels could exchange values without a change of either sum
    mixed = (values ^ (values >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15)
    result: UInt64[ndarray, " n"] = mixed ^ (mixed >> np.uint64(29))
    return result
