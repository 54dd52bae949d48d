"""Read a layer of the fused map and its changes for a watcher, tile by tile, without holding the map for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gausslite.domain.checks import require_identifier
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import (
    TILE_VOXELS,
    AxisAlignedBox,
    VoxelBatch,
    VoxelGrid,
    crop_to_box,
    merge_batches,
    tombstones,
)
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.fused_map import MapLayer, WonVoxels
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.gaussians_pb2 import Provenance
from gausslite.wire.convert import box_from_message
from gausslite.wire.map_changes import EncodedPart, EncodedPartCache, Parts, encode_parts
from gausslite_fusion_server.messages import layer_from_message

_SENDER = "fusion-server"
"""The agent id inside the subset bytes of fused voxels; readers use the provenance instead."""


@dataclass(frozen=True, slots=True)
class WatchedPart:
    """What a watcher wants: a layer, the part in a region, without the voxels that one agent wins."""

    layer: MapLayer
    region: AxisAlignedBox | None = None
    exclude_agent: str = ""


def watched_part(request: pb.WatchFusedMapRequest) -> WatchedPart:
    """Return what a watcher asks for. Raises InvalidInputError."""
    layer, exclude_agent = layer_from_message(request.layer), request.exclude_agent_id
    if exclude_agent:
        require_identifier("exclude_agent_id", exclude_agent)
        if layer is MapLayer.REFINED:
            raise InvalidInputError("exclude_agent_id: expected none with REFINED, whose voxels belong to everyone")
    region = box_from_message(request.region) if request.HasField("region") else None
    return WatchedPart(layer, region, exclude_agent)


@dataclass(frozen=True, slots=True, eq=False)
class FusedMapReader:
    """Reads what one watcher wants; a tile is read when its block is due. The cache is that of all watchers."""

    engine: FusionEngine
    watched: WatchedPart
    cache: EncodedPartCache
    since_revision: int = 0  # where the watcher begins; from there it gets all changes as one

    def snapshot(self) -> tuple[int, Parts]:
        """Return the current revision and the tiles of the layer, each as it is when it is read."""
        revision, tiles = self.engine.maps.tiles(self.watched.layer)
        return revision, (self._tile(tile) for tile in self._in_region(tiles).tolist())

    def changes(self, since_revision: int) -> tuple[int, Parts]:
        """Return the current revision and what changed since, or more. Raises RevisionGoneError."""
        newest = self.engine.maps.revision(self.watched.layer)
        if newest == since_revision:
            return since_revision, ()
        is_first = since_revision == self.since_revision
        shared = replace(self.watched, exclude_agent="")
        revision = newest if is_first else self.cache.step((shared, since_revision), newest)

        # the map is read once for all watchers that follow closely
        def encode(watched: WatchedPart) -> tuple[EncodedPart, ...]:
            changes = self.engine.maps.changes(since_revision, watched.layer)
            won = self._select(watched, changes.won)
            changed = np.union1d(changes.won.batch.keys, changes.removed)
            if watched.region is not None:
                changed = changed[watched.region.contains(self.engine.grid.centres_m(changed))]
            return _encode(won, np.setdiff1d(changed, won.batch.keys), self.engine.grid)

        return revision, (self._shared(self.watched, (since_revision, revision), encode),)

    def _tile(self, tile: int) -> tuple[EncodedPart, ...]:
        """Return a tile as it is now; a tile completely in the region is shared with other watchers."""
        watched = self.watched
        if watched.region is not None and _contains(watched.region, tile, self.engine.grid):
            watched = replace(watched, region=None)
        # read before the tile: a change in between makes the kept tile newer than its revision, never older
        revision = self.engine.maps.tile_revision(watched.layer, tile)

        def encode(watched: WatchedPart) -> tuple[EncodedPart, ...]:
            won = self._select(watched, self.engine.maps.tile(watched.layer, tile))
            return _encode(won, np.zeros(0, np.int64), self.engine.grid)

        return self._shared(watched, (tile, revision), encode)

    def _shared(
        self, watched: WatchedPart, key: tuple[int, int], encode: Callable[[WatchedPart], tuple[EncodedPart, ...]]
    ) -> tuple[EncodedPart, ...]:
        """Return parts from the cache; an agent that wins nothing in them is excluded by those of all watchers."""
        everyone = replace(watched, exclude_agent="")
        parts = self.cache.get((everyone, *key), partial(encode, everyone))
        winners = {name for _, provenance in parts if provenance is not None for name in provenance.agent_ids}
        if watched.exclude_agent in winners:
            return self.cache.get((watched, *key), partial(encode, watched))
        return parts

    def _select(self, watched: WatchedPart, won: WonVoxels) -> WonVoxels:
        if watched.exclude_agent:
            won = won.without(watched.exclude_agent)
        if watched.region is None:
            return won
        return WonVoxels(crop_to_box(won.batch, watched.region, self.engine.grid), won.keys_by_winner)

    def _in_region(self, tiles: np.ndarray) -> np.ndarray:
        grid, region = self.engine.grid, self.watched.region
        if region is None:
            return tiles
        low_m = grid.indices(tiles) * grid.size_m
        high_m = low_m + TILE_VOXELS * grid.size_m
        touches = (low_m <= np.array(region.max_m)) & (high_m >= np.array(region.min_m))
        return tiles[touches.all(axis=1)]


def _encode(won: WonVoxels, removed: np.ndarray, grid: VoxelGrid) -> tuple[EncodedPart, ...]:
    """Encode voxels and, as tombstones, the keys of empty ones; no part if there are none."""
    agents = sorted(won.keys_by_winner)
    winner_of = {key: index for index, name in enumerate(agents) for key in won.keys_by_winner[name]}

    def provenance(part: VoxelBatch) -> Provenance:
        if not agents:
            return Provenance()
        return Provenance(agent_ids=agents, winner=[winner_of.get(key, 0) for key in part.keys.tolist()])

    return encode_parts(merge_batches(won.batch, tombstones(removed)), grid, _SENDER, provenance)


def _contains(region: AxisAlignedBox, tile: int, grid: VoxelGrid) -> bool:
    low_m = grid.indices(np.array([tile], np.int64)) * grid.size_m
    return bool(region.contains(np.concatenate([low_m, low_m + TILE_VOXELS * grid.size_m]).astype(np.float32)).all())
