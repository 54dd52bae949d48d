"""Convert digests of updates to messages and back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from gausslite.domain.errors import CodecError
from gausslite.domain.tile_digests import TileDigests
from gausslite.v1 import fusion_service_pb2 as pb

_TILES_PER_MESSAGE = 1 << 14
_MAX_TILES = 1 << 22


def digests_to_messages(digests: TileDigests) -> Iterator[pb.GetUpdateDigestsResponse]:
    """Yield messages of 16 bytes per tile, at most 256 KiB each; none without tiles."""
    for start in range(0, len(digests.tiles), _TILES_PER_MESSAGE):
        part = slice(start, start + _TILES_PER_MESSAGE)
        yield pb.GetUpdateDigestsResponse(tiles=digests.tiles[part].tolist(), hashes=digests.hashes[part].tolist())


def digests_from_messages(messages: Iterable[pb.GetUpdateDigestsResponse]) -> TileDigests:
    """Return the digests of all messages. Raises CodecError for inconsistent lengths or too many tiles."""
    parts: list[TileDigests] = []
    count = 0
    for message in messages:
        tiles, hashes = np.array(message.tiles, np.int64), np.array(message.hashes, np.uint64)
        count += len(tiles)
        if len(tiles) != len(hashes) or count > _MAX_TILES:
            raise CodecError(
                f"digests: expected as many hashes as tiles and at most {_MAX_TILES}, got {count} and {len(hashes)}"
            )
        parts.append(TileDigests(tiles, hashes))
    return TileDigests.sum_of(parts)
