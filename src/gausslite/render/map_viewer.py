"""Render a finished map from any pose."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer, Rendering, gaussians_to_rows


class MapViewer:
    """Renders one map from many poses; converts it to splat rows once. It owns neither the map nor the rasterizer."""

    def __init__(self, gaussians: Gaussians, rasterizer: Rasterizer) -> None:
        self._rows = gaussians_to_rows(gaussians)
        self._rasterizer = rasterizer

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], motion: CameraMotion | None = None
    ) -> Rendering:
        """Return the map's rendering from this camera pose; colours are clipped to [0, 1]. Raises ShapeError."""
        rendering = self._rasterizer.forward(self._rows, camera, inverse(T_world_camera), motion=motion)
        # copies: a backend may reuse its images for the next rendering
        return Rendering(np.clip(rendering.rgb, 0.0, 1.0), rendering.depth_m.copy(), rendering.alpha.copy(), None)

    def render_frame(self, frame: Frame) -> Rendering:
        """Return the map's rendering from the frame's camera pose, with the frame's motion."""
        return self.render(frame.camera, frame.T_world_camera, frame.motion)


def view_map(gaussians: Gaussians, backend: str = "auto", threads: int | None = None) -> MapViewer:
    """Return a viewer with a rasterizer of its own, see `choose_rasterizer`. Raises KernelError."""
    return MapViewer(gaussians, choose_rasterizer(backend, threads))
