"""Held-out views with the mask of the task's region, and rendering of a finished map from any pose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.region import Region
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer, Rendering
from gausslite.render.row_encoding import gaussians_to_rows

MIN_ROI_PIXELS = 64
"""Views with fewer region pixels are not scored inside the region."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutView:
    """A frame that no map was trained on, and the mask of the task's region."""

    frame: Frame
    roi: Bool[ndarray, "h w"]

    def __post_init__(self) -> None:
        require_array("view roi", self.roi, self.frame.depth_m.shape, np.bool_)

    @classmethod
    def of(cls, frame: Frame, regions: Iterable[Region]) -> HeldOutView:
        """Return the frame with the union of these regions' masks."""
        roi = np.zeros(frame.depth_m.shape, np.bool_)
        for region in regions:
            roi |= region.mask(frame)
        return cls(frame, roi)

    @property
    def shows_region(self) -> bool:
        """True if the view shows at least MIN_ROI_PIXELS of the region."""
        return int(np.count_nonzero(self.roi)) >= MIN_ROI_PIXELS


def largest_roi_views(views: Sequence[HeldOutView], count: int) -> set[int]:
    """Return the positions of the views with the largest region in each of `count` segments of the sequence."""
    return largest_roi_per_segment([int(np.count_nonzero(view.roi)) for view in views], count)


def largest_roi_per_segment(roi_pixels: Sequence[int], count: int) -> set[int]:
    """Return the position of the largest region in each of `count` segments.

    Regions below MIN_ROI_PIXELS are skipped unless all are below.
    """
    if count < 1:
        return set()
    pixels = np.array(roi_pixels)
    segments = [part for part in np.array_split(np.arange(len(pixels)), count) if len(part)]
    best = {int(part[np.argmax(pixels[part])]) for part in segments}
    return {i for i in best if pixels[i] >= MIN_ROI_PIXELS} or best


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


def view_maps(maps: Mapping[str, Gaussians], threads: int | None = None) -> dict[str, MapViewer]:
    """Return a viewer of each map; all of them share one rasterizer. Raises KernelError."""
    rasterizer = choose_rasterizer(threads=threads)
    return {name: MapViewer(gaussians, rasterizer) for name, gaussians in maps.items()}
