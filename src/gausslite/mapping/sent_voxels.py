"""Choose which Gaussians leave the robot: in the task's region, changed since the last time, voxel by voxel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64, UInt64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import VoxelIndex, merge_batches, select_voxels, tombstones
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import MapFileError


class SentVoxelTracker:
    """Knows the last word given on each voxel, as three numbers: Σκ, count and a fingerprint of the contents.

    Words on what was an earlier task's region are released: they stand as they were given, whatever becomes of those
    Gaussians, until the voxel holds a region again that was trained as much.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._keys = np.zeros(0, np.int64)
        self._states = np.zeros((0, 3), np.uint64)
        self._released = np.zeros(0, np.bool_)

    def collect_changes(self, gaussians: Gaussians) -> VoxelBatch:
        """Words on the voxels whose active Gaussians are new or changed since the last call.

        A voxel that held active Gaussians then and holds none now gets a tombstone (count 0), unless it is released.
        """
        active = gaussians if gaussians.active.all() else gaussians.take(gaussians.active)
        voxels = VoxelIndex.from_points(active.means_m, self._grid)
        keys, kappa_sums, counts = voxels.keys, voxels.sums(active.kappa), voxels.counts.astype(np.uint32)
        states = np.stack([kappa_sums, counts.astype(np.uint64), voxels.sums(_fingerprints(active))], axis=1)
        heard = self._outgrow_released(keys, kappa_sums)
        new = heard & ~self._unchanged(keys, states)
        absent = ~np.isin(self._keys, keys[heard], assume_unique=True)
        vanished = self._keys[absent & ~self._released]
        self._remember(keys[heard], states[heard], absent & self._released)
        words = VoxelBatch(keys[new], kappa_sums[new], counts[new], active.take(voxels.rows_in(new)))
        return merge_batches(words, tombstones(vanished)) if len(vanished) else words

    def freeze_sent(self) -> None:
        """The task is another one: what was said stays true of its time, and is neither taken back nor followed."""
        self._released = np.ones(len(self._keys), np.bool_)

    def exclude_frozen(self, words: VoxelBatch) -> VoxelBatch:
        """These words without those that would replace a released one that was trained more."""
        return select_voxels(words, self._outgrow_released(words.keys, words.kappa_sums))

    def mark_all_unsent(self) -> None:
        """Treat every voxel as new at the next call (the receiver lost what it had)."""
        self._keys, self._states = np.zeros(0, np.int64), np.zeros((0, 3), np.uint64)
        self._released = np.zeros(0, np.bool_)

    def state(self) -> State:
        """The last words given."""
        return {"keys": self._keys, "states": self._states, "released": self._released}

    def restore(self, state: State) -> None:
        """Take over what another ledger said. Raises MapFileError, ShapeError."""
        keys = get_array(state, "keys", (None,), np.int64)
        if (keys[1:] <= keys[:-1]).any():
            raise MapFileError("state keys: expected strictly ascending voxel keys, got others")
        self._states = get_array(state, "states", (len(keys), 3), np.uint64).copy()
        self._released = get_array(state, "released", (len(keys),), np.bool_).copy()
        self._keys = keys.copy()

    def _outgrow_released(self, keys: Int64[ndarray, " v"], kappa_sums: UInt64[ndarray, " v"]) -> Bool[ndarray, " v"]:
        """True for voxels on which no released word was trained more."""
        released, sums = self._keys[self._released], self._states[self._released, 0]
        if len(released) == 0:
            return np.ones(len(keys), np.bool_)
        place = np.minimum(np.searchsorted(released, keys), len(released) - 1)
        outgrown: Bool[ndarray, " v"] = (released[place] != keys) | (kappa_sums >= sums[place])
        return outgrown

    def _remember(
        self, keys: Int64[ndarray, " v"], states: UInt64[ndarray, "v 3"], still_released: Bool[ndarray, " k"]
    ) -> None:
        """These are the last words now, beside those of before that stay released."""
        all_keys = np.concatenate([keys, self._keys[still_released]])
        order = np.argsort(all_keys, kind="stable")
        self._states = np.concatenate([states, self._states[still_released]])[order]
        self._keys, self._released = all_keys[order], order >= len(keys)

    def _unchanged(self, keys: Int64[ndarray, " v"], states: UInt64[ndarray, "v 3"]) -> Bool[ndarray, " v"]:
        if len(self._keys) == 0:
            return np.zeros(len(keys), np.bool_)
        place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        same: Bool[ndarray, " v"] = (self._keys[place] == keys) & (self._states[place] == states).all(axis=1)
        return same


def _fingerprints(gaussians: Gaussians) -> UInt64[ndarray, " n"]:
    """A number per Gaussian that changes with any of its values; a voxel's is their sum, whatever their order."""
    g = gaussians
    columns = [*g.means_m.T, *g.quats_wxyz.T, *g.scales_m.T, g.opacities, *g.rgb.T]
    # odd multipliers from a fixed seed: equal Gaussians give equal numbers in every run
    multipliers = np.random.default_rng(0).integers(0, 2**64, len(columns), np.uint64) | np.uint64(1)
    total = g.target.astype(np.uint64)
    product = np.empty_like(total)
    # column by column, so that what is summed stays in cache
    for column, multiplier in zip(columns, multipliers, strict=True):
        total += np.multiply(column.view(np.uint32), multiplier, out=product)
    return _mix(total)


def _mix(values: UInt64[ndarray, " n"]) -> UInt64[ndarray, " n"]:
    # without this step the sums of two voxels' contents could trade parts unnoticed
    mixed = (values ^ (values >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15)
    result: UInt64[ndarray, " n"] = mixed ^ (mixed >> np.uint64(29))
    return result
