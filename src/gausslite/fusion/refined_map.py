"""The refined map, in which voxels that changed after the start of the refinement have the newer vote's Gaussians."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt64
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from gausslite.codec.records import from_bytes, to_records
from gausslite.domain.column_hash import hash_columns
from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import merge_batches, select_voxels
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import FusedMap, VoteResult

# no agent can have an empty id
_OWNER, RECORD = "", "refined-map"


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap:
    """The result of a refinement and the fused revision it started from."""

    batch: VoxelBatch
    revision: int

    def replace_changed(self, newer: FusedMap, changed: Int64[ndarray, " c"]) -> VoxelBatch:
        """Return the refined voxels, with the newer vote in place of the voxels in `changed`."""
        kept = select_voxels(self.batch, ~np.isin(self.batch.keys, changed))
        return merge_batches(kept, newer.batch)


@dataclass(frozen=True, slots=True, eq=False)
class StoredRefinement:
    """A refined map without the voxels that have changed, and a hash of the vote's winner in every unchanged voxel.

    After a restart, the hashes tell which voxels have changed since. voted_keys are ascending.
    """

    batch: VoxelBatch
    voted_keys: Int64[ndarray, " v"]
    winner_hashes: UInt64[ndarray, " v"]

    @classmethod
    def of(cls, refined: RefinedMap, vote: VoteResult, changed: Int64[ndarray, " c"]) -> StoredRefinement:
        """Return what is stored of a refinement; changed: the voxels that changed since it started."""
        unchanged = ~np.isin(vote.keys, changed)
        batch = select_voxels(refined.batch, ~np.isin(refined.batch.keys, changed))
        return cls(batch, vote.keys[unchanged], _winner_hashes(vote)[unchanged])

    def changed_voxels(self, vote: VoteResult) -> Int64[ndarray, " c"]:
        """Return the voxels of the vote that have another winner, or another update of it, than in the refinement."""
        _, stored, now = np.intersect1d(self.voted_keys, vote.keys, assume_unique=True, return_indices=True)
        changed = np.ones(len(vote), np.bool_)
        changed[now] = self.winner_hashes[stored] != _winner_hashes(vote)[now]
        return vote.keys[changed]

    def without_removed(self, vote: VoteResult) -> VoxelBatch:
        """Return the refined voxels without those that have left the vote since."""
        removed = np.setdiff1d(self.voted_keys, vote.keys, assume_unique=True)
        return select_voxels(self.batch, ~np.isin(self.batch.keys, removed))


def save_refinement(store: FusionStore, stored: StoredRefinement) -> None:
    """Replace the store's refinement. Raises StorageError."""
    batch = stored.batch
    columns = {
        "keys": batch.keys,
        "kappa_sums": batch.kappa_sums,
        "counts": batch.counts,
        "records": np.frombuffer(to_records(batch.gaussians).tobytes(), np.uint8),
        "voted_keys": stored.voted_keys,
        "winner_hashes": stored.winner_hashes,
    }
    store.save_record(_OWNER, RECORD, save({name: np.ascontiguousarray(each) for name, each in columns.items()}))


def load_refinement(store: FusionStore) -> StoredRefinement | None:
    """Return the store's refinement, None without one. Raises CodecError, StorageError."""
    data = store.records(RECORD).get(_OWNER)
    return None if data is None else _decode_refinement(data)


def _decode_refinement(data: bytes) -> StoredRefinement:
    """Return a stored refinement. Raises CodecError."""
    try:
        columns = load(data)
        gaussians = from_bytes(columns["records"].tobytes())
        batch = VoxelBatch(columns["keys"], columns["kappa_sums"], columns["counts"], gaussians)
        return StoredRefinement(batch, columns["voted_keys"], columns["winner_hashes"])
    except (SafetensorError, KeyError, ValueError, GaussLiteError) as error:
        raise CodecError(f"stored refinement: expected its arrays, got other bytes ({error})") from error


def _winner_hashes(vote: VoteResult) -> UInt64[ndarray, " v"]:
    first = vote.offsets[:-1]
    names = np.array([zlib.crc32(name.encode()) for name in vote.agents], np.uint64)
    return hash_columns(names[vote.winner_index], vote.update_seqs[first], vote.kappa_sums[first], vote.counts[first])
