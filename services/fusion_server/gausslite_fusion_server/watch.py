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
class WatchFilter:
    """Which voxels of the fused map a watcher wants."""

    layer: MapLayer
    region: AxisAlignedBox | None = None  # None: everywhere
    exclude_agent: str = ""  # without the voxels that this agent wins; empty: all


def watch_filter(request: pb.WatchFusedMapRequest) -> WatchFilter:
    """Return what a watcher asks for. Raises InvalidInputError."""
    layer, exclude_agent = layer_from_message(request.layer), request.exclude_agent_id
    if exclude_agent:
        require_identifier("exclude_agent_id", exclude_agent)
        if layer is MapLayer.REFINED:
            raise InvalidInputError("exclude_agent_id: expected none with REFINED, whose voxels belong to everyone")
    region = box_from_message(request.region) if request.HasField("region") else None
    return WatchFilter(layer, region, exclude_agent)


@dataclass(frozen=True, slots=True, eq=False)
class FusedMapReader:
    """Reads what one watcher wants; a tile is read when its block is due. The cache is that of all watchers."""

    engine: FusionEngine
    wanted: WatchFilter
    cache: EncodedPartCache
    since_revision: int = 0  # where the watcher begins; from there it gets all changes as one

    def snapshot(self) -> tuple[int, Parts]:
        """Return the current revision and the tiles of the layer, each as it is when it is read."""
        revision, tiles = self.engine.maps.tiles(self.wanted.layer)
        return revision, (self._tile(tile) for tile in self._in_region(tiles).tolist())

    def changes(self, since_revision: int) -> tuple[int, Parts]:
        """Return a revision and what has changed until then; it may have more changes. Raises RevisionGoneError."""
        newest = self.engine.maps.revision(self.wanted.layer)
        if newest == since_revision:
            return since_revision, ()
        # a step from one revision to the next is the same for all watchers that follow, so that the map is read and
        # encoded once for them; the first step of a watcher is its own, from wherever it was before
        is_first = since_revision == self.since_revision
        everyone = replace(self.wanted, exclude_agent="")
        revision = newest if is_first else self.cache.step((everyone, since_revision), newest)

        def encode(wanted: WatchFilter) -> tuple[EncodedPart, ...]:
            changes = self.engine.maps.changes(since_revision, wanted.layer)
            won = self._select(wanted, changes.won)
            changed = np.union1d(changes.won.batch.keys, changes.removed)
            if wanted.region is not None:
                changed = changed[wanted.region.contains(self.engine.grid.centres_m(changed))]
            return _encode(won, np.setdiff1d(changed, won.batch.keys), self.engine.grid)

        return revision, (self._shared(self.wanted, (since_revision, revision), encode),)

    def _tile(self, tile: int) -> tuple[EncodedPart, ...]:
        """Return a tile as it is now; a tile completely in the region is shared with other watchers."""
        wanted = self.wanted
        if wanted.region is not None and _contains(wanted.region, tile, self.engine.grid):
            wanted = replace(wanted, region=None)
        # read before the tile: a change in between makes the kept tile newer than its revision, never older
        revision = self.engine.maps.tile_revision(wanted.layer, tile)

        def encode(wanted: WatchFilter) -> tuple[EncodedPart, ...]:
            won = self._select(wanted, self.engine.maps.tile(wanted.layer, tile))
            return _encode(won, np.zeros(0, np.int64), self.engine.grid)

        return self._shared(wanted, (tile, revision), encode)

    def _shared(
        self, wanted: WatchFilter, key: tuple[int, int], encode: Callable[[WatchFilter], tuple[EncodedPart, ...]]
    ) -> tuple[EncodedPart, ...]:
        """Return parts from the cache; an agent that wins nothing in them is excluded by those of all watchers."""
        everyone = replace(wanted, exclude_agent="")
        parts = self.cache.get((everyone, *key), partial(encode, everyone))
        winners = {name for _, provenance in parts if provenance is not None for name in provenance.agent_ids}
        if wanted.exclude_agent in winners:
            return self.cache.get((wanted, *key), partial(encode, wanted))
        return parts

    def _select(self, wanted: WatchFilter, won: WonVoxels) -> WonVoxels:
        if wanted.exclude_agent:
            won = won.without(wanted.exclude_agent)
        if wanted.region is None:
            return won
        return WonVoxels(crop_to_box(won.batch, wanted.region, self.engine.grid), won.keys_by_winner)

    def _in_region(self, tiles: np.ndarray) -> np.ndarray:
        grid, region = self.engine.grid, self.wanted.region
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
