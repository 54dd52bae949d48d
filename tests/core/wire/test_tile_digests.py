"""Digests of updates by tile: equal for equal updates in any order, and only changed tiles differ."""

import numpy as np
import pytest

from gausslite.domain.errors import CodecError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import VoxelGrid, tile_of
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.convert import digests_from_messages, digests_to_messages

RNG = np.random.default_rng(0)
KEYS = np.unique(VoxelGrid(0.1).keys(RNG.uniform(-40, 40, (40_000, 3)).astype(np.float32)))
SEQS = RNG.integers(1, 1 << 40, len(KEYS))


def test_the_order_of_updates_and_their_parts_do_not_matter() -> None:
    digests, order = TileDigests.of(KEYS, SEQS), RNG.permutation(len(KEYS))
    shuffled = TileDigests.of(KEYS[order], SEQS[order])
    parts = TileDigests.sum_of(TileDigests.of(KEYS[i::3], SEQS[i::3]) for i in range(3))
    for other in (shuffled, parts):
        assert np.array_equal(other.tiles, digests.tiles)
        assert np.array_equal(other.hashes, digests.hashes)
    assert len(digests.differing(parts)) == len(TileDigests.sum_of(()).tiles) == 0


@pytest.mark.parametrize("lost", [0, 17, len(KEYS) - 1])
def test_a_lost_and_a_changed_update_are_found_in_their_tile(lost: int) -> None:
    digests, tile = TileDigests.of(KEYS, SEQS), tile_of(int(KEYS[lost]))
    without = TileDigests.of(np.delete(KEYS, lost), np.delete(SEQS, lost))
    older = TileDigests.of(KEYS, SEQS - (np.arange(len(KEYS)) == lost))
    assert digests.differing(without).tolist() == digests.differing(older).tolist() == [tile]


def test_digests_come_back_from_their_messages() -> None:
    digests = TileDigests.of(KEYS, SEQS)
    messages = list(digests_to_messages(digests))
    assert len(messages) > 1
    assert sum(each.ByteSize() for each in messages) < 16.1 * len(digests.tiles)
    assert len(digests.differing(digests_from_messages(messages))) == 0
    assert len(digests_from_messages([]).tiles) == 0
    with pytest.raises(CodecError, match="as many hashes as tiles"):
        digests_from_messages([pb.GetUpdateDigestsResponse(tiles=[1], hashes=[])])
