"""The rows of a store in a database: encode, check and index them. Each row has a checksum."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence

import google_crc32c
import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.codec.stored import from_stored, is_stored
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.score_index import ScoreIndex
from gausslite.fusion.store import StoredScores

UpdateRow = tuple[str, int, int, int, int, int, bytes]
"""agent_id, voxel, update_seq, Σkappa, count, checksum, Gaussians."""
_UPDATE_HEADER = struct.Struct("<qqqq")


def update_rows(subset: RoiSubset, encoded: Sequence[bytes], selected: Bool[ndarray, " v"]) -> Iterator[UpdateRow]:
    """Yield the rows of the selected voxels of a message; encoded: the Gaussians of each voxel as they are stored."""
    batch = subset.batch
    for i in np.flatnonzero(selected).tolist():
        key = int(batch.keys[i])
        scores = subset.update_seq, int(batch.kappa_sums[i]), int(batch.counts[i])
        yield (subset.agent_id, key, *scores, update_checksum(subset.agent_id, key, scores, encoded[i]), encoded[i])


def is_intact(row: UpdateRow) -> bool:
    """Return whether a row of updates has its checksum and as many Gaussians as it counts."""
    agent_id, voxel, update_seq, kappa_sum, count, checksum, gaussians = row
    return (
        is_stored(gaussians, count)
        and update_checksum(agent_id, voxel, (update_seq, kappa_sum, count), gaussians) == checksum
    )


def batch_of_rows(rows: Sequence[UpdateRow]) -> VoxelBatch:
    """Return the updates of one agent; the rows are sorted by voxel."""
    keys, counts = np.array([row[1] for row in rows], np.int64), np.array([row[4] for row in rows], np.uint32)
    sums = np.array([row[3] for row in rows], np.uint64)
    return VoxelBatch(keys, sums, counts, from_stored(keys, counts, [row[6] for row in rows]))


def index_rows(index: ScoreIndex, rows: Sequence[UpdateRow]) -> None:
    """Put the totals of the rows into the index; the rows are sorted by agent."""
    for agent_id, own in itertools.groupby(rows, key=lambda row: row[0]):
        _, voxels, seqs, sums, counts, _, _ = zip(*own, strict=True)
        columns = np.array(seqs, np.int64), np.array(sums, np.uint64), np.array(counts, np.uint32)
        index.put(agent_id, np.array(voxels, np.int64), StoredScores(*columns))


def update_checksum(agent_id: str, voxel: int, scores: tuple[int, int, int], gaussians: bytes) -> int:
    """Return the CRC32C of an update; scores: its update_seq, Σkappa and count."""
    head = agent_id.encode() + _UPDATE_HEADER.pack(voxel, *scores)
    return int(google_crc32c.extend(google_crc32c.value(head), gaussians))


def data_checksum(owner: str, name: str | int, data: bytes) -> int:
    """Return the CRC32C of a keyframe or record."""
    return int(google_crc32c.extend(google_crc32c.value(f"{owner}\0{name}".encode()), data))
