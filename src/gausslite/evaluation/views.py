"""Look at a finished map from a held-out frame, and know which of its pixels belong to the task."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.region import Region
from gausslite.optimize.parameters import gaussians_to_rows
from gausslite.render.rasterizer import Rasterizer, Rendering

MIN_ROI_PIXELS = 64
"""A view that shows fewer of the region's pixels says nothing of it."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutView:
    """A frame that no map was trained on, and the pixels that show the task's region."""

    frame: Frame
    roi: Bool[ndarray, "h w"]

    def __post_init__(self) -> None:
        require_array("view roi", self.roi, self.frame.depth_m.shape, np.bool_)

    @classmethod
    def of(cls, frame: Frame, regions: Iterable[Region]) -> HeldOutView:
        """The frame with the union of these regions' masks."""
        roi = np.zeros(frame.depth_m.shape, np.bool_)
        for region in regions:
            roi |= region.mask(frame)
        return cls(frame, roi)

    @property
    def shows_region(self) -> bool:
        """Whether enough of the region is seen to be judged."""
        return int(np.count_nonzero(self.roi)) >= MIN_ROI_PIXELS


def largest_roi_views(views: Sequence[HeldOutView], count: int) -> set[int]:
    """From each of `count` stretches of the sequence, the view with the largest region."""
    return largest_roi_per_segment([int(np.count_nonzero(view.roi)) for view in views], count)


def largest_roi_per_segment(roi_pixels: Sequence[int], count: int) -> set[int]:
    """The largest region's position in each of `count` stretches; passes over those too small to judge, if it can."""
    if count < 1:
        return set()
    pixels = np.array(roi_pixels)
    stretches = [part for part in np.array_split(np.arange(len(pixels)), count) if len(part)]
    best = {int(part[np.argmax(pixels[part])]) for part in stretches}
    return {i for i in best if pixels[i] >= MIN_ROI_PIXELS} or best


class MapViewer:
    """One map, brought into rows once and drawn from many poses. It owns neither the map nor the rasterizer."""

    def __init__(self, gaussians: Gaussians, rasterizer: Rasterizer) -> None:
        self._rows = gaussians_to_rows(gaussians)
        self._rasterizer = rasterizer

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Rendering:
        """The map as this camera sees it; colours clipped to [0, 1]. Raises ShapeError."""
        drawn = self._rasterizer.forward(self._rows, camera, inverse(T_world_camera))
        # copies: a backend may reuse its images for the next rendering
        return Rendering(np.clip(drawn.rgb, 0.0, 1.0), drawn.depth_m.copy(), drawn.alpha.copy(), None)

    def render_frame(self, frame: Frame) -> Rendering:
        """The map from where the frame was taken."""
        return self.render(frame.camera, frame.T_world_camera)
