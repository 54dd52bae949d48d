"""Split a batch of voxels into self-contained messages for a watcher, each far below the client's size limit."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance

_BLOCK_BYTES = 1 << 19


def map_blocks(
    batch: VoxelBatch,
    grid: VoxelGrid,
    sender: str,
    revision: int,
    snapshot: bool,
    provenance: Callable[[VoxelBatch], Provenance] | None = None,
) -> Iterator[MapBlock]:
    """Yield the blocks of one revision, at least one; each is encoded on request.

    sender is the agent id inside the encoded bytes; provenance returns the agent of each voxel of a part. Raises
    InvalidInputError if the codec cannot encode the batch.
    """
    parts = split_batch(batch, _BLOCK_BYTES)
    for number, part in enumerate(parts or [batch], start=1):
        yield MapBlock(
            revision=revision,
            snapshot=snapshot,
            last=number >= len(parts),
            subset=encode_subset(RoiSubset(sender, "", number, revision, part), grid) if parts else b"",
            provenance=None if provenance is None else provenance(part),
        )
