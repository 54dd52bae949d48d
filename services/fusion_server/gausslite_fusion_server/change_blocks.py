"""Stream a layer of the fused map and its changes to a watcher, tile by tile, without holding the map for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gausslite.domain.errors import InvalidInputError, RevisionGoneError
from gausslite.domain.voxel_operations import crop_to_box
from gausslite.domain.voxels import TILE_VOXELS, AxisAlignedBox, VoxelGrid
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.fused_map import MapLayer, WonVoxels
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite_fusion_server.encoded_blocks import EncodedPart, EncodedPartCache, encode_parts


@dataclass(frozen=True, slots=True)
class WatchedPart:
    """What a watcher wants: a layer, the part in a region, without the voxels that one agent wins."""

    layer: MapLayer
    region: AxisAlignedBox | None = None
    exclude_agent: str = ""

    def __post_init__(self) -> None:
        if self.exclude_agent and self.layer is MapLayer.REFINED:
            raise InvalidInputError("exclude_agent_id: expected none with REFINED, whose voxels belong to everyone")


class ChangeBlocks:
    """Encodes blocks for all watchers of a map. Thread-safe; each iterator belongs to one watcher."""

    def __init__(self, engine: FusionEngine) -> None:
        self._engine, self._grid = engine, engine.grid
        self._cache = EncodedPartCache()

    def blocks(self, watched: WatchedPart, since_revision: int) -> Iterator[MapBlock]:
        """Yield the blocks that lead from a revision (0: nothing) to the current one, at least one; the last is marked.

        A tile is read when its block is due. What changes in the meantime follows before the last block. So the reader
        then has the map at the revision of the last block. Raises RevisionGoneError.
        """
        waiting: MapBlock | None = None
        snapshot = since_revision == 0
        revision = since_revision
        if snapshot:
            revision, tiles = self._engine.maps.tiles(watched.layer)
            for tile in self._in_region(tiles, watched.region).tolist():
                for part in self._tile(watched, tile):
                    if waiting is not None:
                        yield waiting
                    waiting = _block(part, revision, snapshot)
        try:
            end, parts = self._changes(watched, revision)
        except RevisionGoneError:
            if not snapshot:
                raise
            # more was removed during the snapshot than is recorded; from this revision the watcher gets a new one
            end, parts = revision, ()
        for part in parts:
            if waiting is not None:
                yield waiting
            waiting = _block(part, end, snapshot)
        waiting = waiting or MapBlock(snapshot=snapshot)
        waiting.revision, waiting.last = end, True
        yield waiting

    def _changes(self, watched: WatchedPart, since_revision: int) -> tuple[int, tuple[EncodedPart, ...]]:
        """Return the current revision and what changed since."""
        if self._engine.maps.revision(watched.layer) == since_revision:
            return since_revision, ()
        changes = self._engine.maps.changes(since_revision, watched.layer)

        def encode() -> tuple[EncodedPart, ...]:
            won = self._select(watched, changes.won)
            changed = np.union1d(changes.won.batch.keys, changes.removed)
            if watched.region is not None:
                changed = changed[watched.region.contains(self._grid.centres_m(changed))]
            return encode_parts(won, np.setdiff1d(changed, won.batch.keys), self._grid)

        return changes.revision, self._cache.get((watched, since_revision, changes.revision), encode)

    def _tile(self, watched: WatchedPart, tile: int) -> tuple[EncodedPart, ...]:
        """Return a tile as it is now; a tile completely in the region is shared with other watchers."""
        if watched.region is not None and _contains(watched.region, tile, self._grid):
            watched = WatchedPart(watched.layer, None, watched.exclude_agent)
        # read before the tile: a change in between makes the kept tile newer than its revision, never older
        revision = self._engine.maps.tile_revision(watched.layer, tile)

        def encode() -> tuple[EncodedPart, ...]:
            won = self._select(watched, self._engine.maps.tile(watched.layer, tile))
            return encode_parts(won, np.zeros(0, np.int64), self._grid)

        return self._cache.get((watched, tile, revision), encode)

    def _select(self, watched: WatchedPart, won: WonVoxels) -> WonVoxels:
        if watched.exclude_agent:
            won = won.without(watched.exclude_agent)
        if watched.region is None:
            return won
        return WonVoxels(crop_to_box(won.batch, watched.region, self._grid), won.keys_by_winner)

    def _in_region(self, tiles: np.ndarray, region: AxisAlignedBox | None) -> np.ndarray:
        if region is None:
            return tiles
        low_m = self._grid.indices(tiles) * self._grid.size_m
        high_m = low_m + TILE_VOXELS * self._grid.size_m
        touches = (low_m <= np.array(region.max_m)) & (high_m >= np.array(region.min_m))
        return tiles[touches.all(axis=1)]


def _contains(region: AxisAlignedBox, tile: int, grid: VoxelGrid) -> bool:
    low_m = grid.indices(np.array([tile], np.int64)) * grid.size_m
    return bool(region.contains(np.concatenate([low_m, low_m + TILE_VOXELS * grid.size_m]).astype(np.float32)).all())


def _block(part: EncodedPart, revision: int, snapshot: bool) -> MapBlock:
    return MapBlock(revision=revision, snapshot=snapshot, subset=part[0], provenance=part[1])
