"""Samples of an agent's map: of at most 4096 voxels of the same blocks as other maps, or of voxels all over it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64, UInt64
from numpy import ndarray

from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.fusion.alignment import TeamView
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.score_index import COMPARED_VOXELS
from gausslite_places.frame_fit import SAMPLES_PER_VOXEL, SurfaceSamples, opaque_rows

_MAX_THINNED_VOXELS = 12_000
_SAMPLE_BLOCK = 8
"""Voxels on a side of the blocks that are sampled completely or not at all, so that surfaces stay dense."""
_MIN_RECENT = 200
_SLICE_VOXELS = 128
"""Read at once: messages are stored in between."""
SAMPLED = np.dtype([("keys", "i8"), ("update_seqs", "i8"), ("samples", "f2", (SAMPLES_PER_VOXEL, 4))])
"""A voxel's samples: offsets from its centre in voxels, and the luminance; NaN where it has fewer. In a voxel of 10 cm,
half precision is off by 12 um at most."""


class MapSamples:
    """The samples of the most opaque Gaussians of each sampled voxel, with its update_seq."""

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._voxels = np.zeros(0, SAMPLED)
        self._limit = int(np.iinfo(np.uint64).max)

    @property
    def keys(self) -> Int64[ndarray, " s"]:
        """The voxels that have been read."""
        return np.ascontiguousarray(self._voxels["keys"])

    def select(self, keys: Int64[ndarray, " k"]) -> Int64[ndarray, " s"]:
        """Return those of the voxels that are sampled; all maps prefer the same blocks, so that samples overlap."""
        ranks = self._block_hashes(np.union1d(keys, self.keys))
        if np.count_nonzero(ranks <= self._limit) > COMPARED_VOXELS:
            self._limit = int(np.sort(ranks)[COMPARED_VOXELS]) - 1
            self._voxels = self._voxels[self._block_hashes(self.keys) <= self._limit]
        return keys[self._block_hashes(keys) <= self._limit]

    def read(self, team: TeamView, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Replace the samples of these voxels by those of the agent's newest updates. Raises StorageError."""
        for start in range(0, len(keys), _SLICE_VOXELS):
            part = keys[start : start + _SLICE_VOXELS]
            batch = team.store.batch(agent_id, part)
            self._put(part, batch, team.store.scores_of(agent_id, batch.keys)["update_seqs"])

    def in_frame(self, alignment: FrameAlignment, first_seq: int = 0) -> SurfaceSamples:
        """Return the samples of the updates from first_seq on in the fused frame; all if these are few."""
        own = self._voxels[self._voxels["update_seqs"] >= first_seq]
        if np.count_nonzero(_present(own)) < _MIN_RECENT:
            own = self._voxels
        present = _present(own)
        values = own["samples"][present].astype(np.float64)
        voxel = np.repeat(np.arange(len(own)), present.sum(axis=1))
        points_m = self._grid.centres_m(own["keys"])[voxel] + self._grid.size_m * values[:, :3]
        segments = alignment.segment_of(own["update_seqs"])[voxel]
        moved = [
            SurfaceSamples(points_m[segments == segment], values[segments == segment, 3]).moved(
                alignment.transform(int(segment))
            )
            for segment in np.unique(segments)
        ]
        return SurfaceSamples.concatenate(moved)

    def _put(self, keys: Int64[ndarray, " k"], batch: VoxelBatch, update_seqs: Int64[ndarray, " v"]) -> None:
        added, sampled = np.zeros(len(batch), SAMPLED), SurfaceSamples.of(batch)
        added["keys"], added["update_seqs"], added["samples"] = batch.keys, update_seqs, np.nan
        voxel = np.repeat(np.arange(len(batch)), batch.counts)[opaque_rows(batch)]
        place = voxel, np.arange(len(voxel)) - np.searchsorted(voxel, voxel)
        offsets_m = sampled.points_m - self._grid.centres_m(batch.keys)[voxel]
        luminance = np.clip(sampled.luminance, -1e4, 1e4)  # it must be finite in half precision
        added["samples"][place] = np.column_stack([offsets_m / self._grid.size_m, luminance])
        kept = self._voxels[~np.isin(self.keys, keys)]
        self._voxels = np.concatenate([kept, added[np.unique(voxel)]])

    def _block_hashes(self, keys: Int64[ndarray, " k"]) -> UInt64[ndarray, " k"]:
        return hash_columns(*(self._grid.indices(keys) // _SAMPLE_BLOCK).T)


def thinned_samples(team: TeamView, agent_id: str, alignment: FrameAlignment, grid: VoxelGrid) -> SurfaceSamples:
    """Return samples of the agent's whole map, a large one thinned evenly, in the fused frame if that is known.

    The blocks of maps in different frames never coincide, so single voxels are chosen. Raises StorageError.
    """
    keys = team.store.keys(agent_id)
    whole = MapSamples(grid)
    whole.read(team, agent_id, np.sort(keys[np.argsort(hash_columns(keys), kind="stable")[:_MAX_THINNED_VOXELS]]))
    return whole.in_frame(alignment)


def _present(voxels: ndarray) -> Bool[ndarray, "v s"]:
    """Return which samples the voxels have."""
    return np.asarray(~np.isnan(voxels["samples"][:, :, 3]), np.bool_)
