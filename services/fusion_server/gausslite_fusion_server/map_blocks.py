"""Cut a change of the fused map into messages, each complete in itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gausslite.codec.subset_codec import encode_subset, split_words
from gausslite.domain.subset import RoiSubset, VoxelWords
from gausslite.domain.voxels import VoxelGrid
from gausslite.domain.words import take_voxels, tombstones, unite
from gausslite.fusion.team import Changes
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance
from gausslite.wire.convert import Box

_BLOCK_BYTES = 1 << 19
_TEAM = "team"
"""The speaker of fused words; an agent of this name loses nothing, since provenance names agents."""


def map_blocks(changes: Changes, grid: VoxelGrid, region: Box | None) -> Iterator[MapBlock]:
    """The blocks of a change inside a region, encoded one by one as they are asked for; at least one."""
    words = unite(changes.fused.words, tombstones(changes.vanished))
    if region is not None:
        words = take_voxels(words, region.holds(grid.centres_m(words.keys)))
    parts = split_words(words, _BLOCK_BYTES)
    for number, part in enumerate(parts or [words], start=1):
        yield MapBlock(
            revision=changes.revision,
            snapshot=changes.snapshot,
            last=number >= len(parts),
            subset=encode_subset(RoiSubset(_TEAM, "", number, changes.revision, part), grid) if parts else b"",
            provenance=_provenance(part, changes),
        )


def _provenance(part: VoxelWords, changes: Changes) -> Provenance:
    winner = np.zeros(len(part), np.int32)
    election = changes.fused.election
    held = np.isin(part.keys, election.keys)
    winner[held] = election.winner[np.searchsorted(election.keys, part.keys[held])]
    return Provenance(agent_ids=election.agents, winner=winner.tolist())
