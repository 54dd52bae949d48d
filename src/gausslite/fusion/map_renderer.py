"""Render views of the fused map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import QuotaError
from gausslite.domain.pose import inverse
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.fused_map import MapLayer
from gausslite.render.rasterizer import Rasterizer
from gausslite.render.row_encoding import gaussians_to_rows

_MAX_VIEW_PX = 1920 * 1080


@dataclass(frozen=True, slots=True, eq=False)
class LayerView:
    """A rendering of a map layer; depth is 0 where the map is not opaque. revision: of the rendered layer."""

    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    revision: int


class MapRenderer:
    """Renders on one thread; the rasterizer is created with the first view, and the rows are kept per revision."""

    def __init__(self, engine: FusionEngine, create_rasterizer: Callable[[], Rasterizer]) -> None:
        self._engine, self._create_rasterizer = engine, create_rasterizer
        self._rasterizer: Rasterizer | None = None
        self._shown: tuple[MapLayer, int] | None = None
        self._rows = np.zeros((0, 16), np.float32)

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], layer: MapLayer) -> LayerView:
        """Return a view of a layer. Raises QuotaError above two megapixels, KernelError."""
        pixels = camera.width_px * camera.height_px
        if pixels > _MAX_VIEW_PX:
            raise QuotaError(f"view: expected at most {_MAX_VIEW_PX} pixels, got {pixels}")
        revision = self._engine.maps.revision(layer)
        if self._shown != (layer, revision):
            self._rows = gaussians_to_rows(self._engine.maps.layer(layer).gaussians)
            self._shown = layer, revision
        size = camera.height_px, camera.width_px
        rgb, depth_m = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
        if len(self._rows):
            if self._rasterizer is None:
                self._rasterizer = self._create_rasterizer()
            rendering = self._rasterizer.forward(self._rows, camera, inverse(T_world_camera))
            rgb = np.rint(np.clip(rendering.rgb, 0.0, 1.0) * 255).astype(np.uint8)
            depth_m = rendering.expected_depth_m()
        return LayerView(rgb, depth_m, revision)
