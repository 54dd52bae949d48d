"""Samples of an agent's map: of at most 4096 voxels of the same blocks as other maps, or of voxels all over it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64, UInt64
from numpy import ndarray

from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.fusion.alignment import TeamView
from gausslite.fusion.frames import FrameAlignment
from gausslite_places.frame_fit import SurfaceSamples, opaque_rows

_MAX_VOXELS = 4096
_MAX_THINNED_VOXELS = 12_000
_SAMPLE_BLOCK = 8
"""Voxels on a side of the blocks that are sampled completely or not at all, so that surfaces stay dense."""
_MIN_RECENT = 200
_SLICE_VOXELS = 128
"""Read at once: messages are stored in between."""


class MapSamples:
    """The samples of the most opaque Gaussians of each sampled voxel, with its update_seq."""

    def __init__(self) -> None:
        self._samples: dict[int, tuple[int, ndarray]] = {}
        self._limit = int(np.iinfo(np.uint64).max)

    def __len__(self) -> int:
        return len(self._samples)

    def select(self, keys: Int64[ndarray, " k"], grid: VoxelGrid) -> Int64[ndarray, " s"]:
        """Return those of the voxels that are sampled; all maps prefer the same blocks, so that samples overlap."""
        known = np.array(list(self._samples), np.int64)
        every = np.union1d(keys, known)
        ranks = _block_hashes(every, grid)
        if np.count_nonzero(ranks <= self._limit) > _MAX_VOXELS:
            self._limit = int(np.sort(ranks)[_MAX_VOXELS])
            for key in every[ranks >= self._limit].tolist():
                self._samples.pop(key, None)
            self._limit -= 1
        return keys[_block_hashes(keys, grid) <= self._limit]

    def read(self, team: TeamView, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Replace the samples of these voxels by those of the agent's newest updates. Raises StorageError."""
        for start in range(0, len(keys), _SLICE_VOXELS):
            part = keys[start : start + _SLICE_VOXELS]
            batch = team.store.batch(agent_id, part)
            self._put(part, batch, team.store.scores_of(agent_id, batch.keys)["update_seqs"])

    def in_frame(self, alignment: FrameAlignment, first_seq: int = 0) -> SurfaceSamples:
        """Return the samples of the updates from first_seq on in the fused frame; all if these are few."""
        parts = [(seq, values) for seq, values in self._samples.values() if seq >= first_seq]
        if sum(len(values) for _, values in parts) < _MIN_RECENT:
            parts = list(self._samples.values())
        if not parts:
            return SurfaceSamples(np.zeros((0, 3)), np.zeros(0))
        values = np.concatenate([values for _, values in parts]).astype(np.float64)
        seqs = np.repeat([seq for seq, _ in parts], [len(values) for _, values in parts])
        segments = alignment.segment_of(seqs)
        moved = [
            SurfaceSamples(values[segments == segment, :3], values[segments == segment, 3]).moved(
                alignment.transform(int(segment))
            )
            for segment in np.unique(segments)
        ]
        return SurfaceSamples.concatenate(moved)

    def _put(self, keys: Int64[ndarray, " k"], batch: VoxelBatch, update_seqs: Int64[ndarray, " v"]) -> None:
        for key in keys.tolist():
            self._samples.pop(key, None)
        sampled = SurfaceSamples.of(batch)
        values = np.column_stack([sampled.points_m, sampled.luminance])
        ends = np.searchsorted(opaque_rows(batch), batch.offsets)
        for i, (key, seq) in enumerate(zip(batch.keys.tolist(), update_seqs.tolist(), strict=True)):
            if ends[i + 1] > ends[i]:
                self._samples[key] = seq, values[ends[i] : ends[i + 1]]


def thinned_samples(team: TeamView, agent_id: str, alignment: FrameAlignment) -> SurfaceSamples:
    """Return samples of the agent's whole map, a large one thinned evenly, in the fused frame if that is known.

    The blocks of maps in different frames never coincide, so single voxels are chosen. Raises StorageError.
    """
    keys = team.store.keys(agent_id)
    whole = MapSamples()
    whole.read(team, agent_id, np.sort(keys[np.argsort(hash_columns(keys), kind="stable")[:_MAX_THINNED_VOXELS]]))
    return whole.in_frame(alignment)


def _block_hashes(keys: Int64[ndarray, " k"], grid: VoxelGrid) -> UInt64[ndarray, " k"]:
    return hash_columns(*(grid.indices(keys) // _SAMPLE_BLOCK).T)
