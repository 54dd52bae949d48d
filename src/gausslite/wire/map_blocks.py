"""Cut words of a map into messages for a watcher, each complete in itself and well under the size a client takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance

_BLOCK_BYTES = 1 << 19


def map_blocks(
    words: VoxelBatch,
    grid: VoxelGrid,
    speaker: str,
    revision: int,
    snapshot: bool,
    provenance: Callable[[VoxelBatch], Provenance] | None = None,
) -> Iterator[MapBlock]:
    """The blocks of one revision, at least one, encoded one by one as they are asked for.

    speaker is the agent id inside the bytes; provenance tells whose Gaussians a part holds. Raises InvalidInputError
    for words that the codec refuses.
    """
    parts = split_batch(words, _BLOCK_BYTES)
    for number, part in enumerate(parts or [words], start=1):
        yield MapBlock(
            revision=revision,
            snapshot=snapshot,
            last=number >= len(parts),
            subset=encode_subset(RoiSubset(speaker, "", number, revision, part), grid) if parts else b"",
            provenance=None if provenance is None else provenance(part),
        )
