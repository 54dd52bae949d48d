"""Render a layer of the fused map, from a copy that follows it tile by tile.

`MapRenderer` is the default plug-in of the group `gausslite.map_renderers`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.pose import inverse
from gausslite.fusion.fused_map import FusedMapLayers, MapLayer
from gausslite.fusion.refinement import CreateRasterizer
from gausslite.render.rasterizer import ROW_WIDTH, Rasterizer, Rendering, gaussians_to_rows


class _LayerCopy:
    """The rows of a map layer, brought up to date tile by tile, so that the map is held for one tile at a time."""

    def __init__(self) -> None:
        self.rows = np.zeros((0, ROW_WIDTH), np.float32)
        self._revision = 0
        # the revision and the rows of each tile
        self._tiles: dict[int, tuple[int, Float32[ndarray, "n 16"]]] = {}

    def update(self, maps: FusedMapLayers, layer: MapLayer) -> int:
        """Read the tiles that have changed since the latest update; returns the layer's revision before."""
        revision, tiles = maps.tiles(layer)
        if self._revision == revision:
            return revision
        kept, self._tiles = self._tiles, {}
        for tile in tiles.tolist():
            # read before the tile: a change in between makes the copy newer than its revision, never older
            changed_at = maps.tile_revision(layer, tile)
            if tile in kept and kept[tile][0] == changed_at:
                self._tiles[tile] = kept[tile]
            else:
                self._tiles[tile] = changed_at, gaussians_to_rows(maps.tile(layer, tile).batch.gaussians)
        self.rows = np.concatenate([np.zeros((0, ROW_WIDTH), np.float32), *(rows for _, rows in self._tiles.values())])
        self._revision = revision
        return revision


class MapRenderer:
    """Renders on one thread, from an own copy of each layer; the rasterizer is created with the first view."""

    def __init__(self, maps: FusedMapLayers, create_rasterizer: CreateRasterizer) -> None:
        self._maps, self._create_rasterizer = maps, create_rasterizer
        self._rasterizer: Rasterizer | None = None
        self._copies: dict[MapLayer, _LayerCopy] = {}

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], layer: MapLayer
    ) -> tuple[Rendering | None, int]:
        """Return a view of a layer, None of an empty one, and the layer's revision. Raises KernelError."""
        copy = self._copies.setdefault(layer, _LayerCopy())
        revision = copy.update(self._maps, layer)
        if not len(copy.rows):
            return None, revision
        if self._rasterizer is None:
            self._rasterizer = self._create_rasterizer()
        return self._rasterizer.forward(copy.rows, camera, inverse(T_world_camera)), revision
