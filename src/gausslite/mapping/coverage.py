"""Find the pixels that the map does not explain yet, and the parts of the task's region it explains too coarsely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.render.rasterizer import NEAR_M, Rendering

_CELL_PX = 8
_SAME_SURFACE = 0.05
"""A Gaussian within this fraction of the measured depth lies on the surface that is seen."""
_MEDIAN_STEP_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """How the map looks from a frame: how opaque it is, and how far away (0 where it shows nothing)."""

    alpha: Float32[ndarray, "h w"]
    depth_m: Float32[ndarray, "h w"]

    @classmethod
    def from_rendering(cls, rendering: Rendering) -> RenderedView:
        """What a rendering from the frame's pose shows."""
        return cls(rendering.alpha, rendering.expected_depth_m())


def rendered_behind(frame: Frame, sight: RenderedView, depth_error_factor: float) -> Bool[ndarray, "h w"]:
    """Pixels that the map draws far behind what is measured there.

    Far means more than depth_error_factor times the median depth error, taken over every fourth row and column.
    """
    comparable = (frame.depth_m > 0) & (sight.depth_m > 0)
    behind_m = sight.depth_m - frame.depth_m
    sample = (slice(None, None, _MEDIAN_STEP_PX), slice(None, None, _MEDIAN_STEP_PX))
    errors_m = np.abs(behind_m[sample][comparable[sample]])
    typical_m = float(np.median(errors_m)) if len(errors_m) else 0.0
    far: Bool[ndarray, "h w"] = comparable & (behind_m > depth_error_factor * typical_m)
    return far


def undersampled_roi(
    frame: Frame, region: Bool[ndarray, "h w"], active_means_m: Float32[ndarray, "n 3"], pixels_per_active: float
) -> Bool[ndarray, "h w"]:
    """Pixels of the region in 8x8 cells that hold less than one active Gaussian for `pixels_per_active` pixels.

    This is what makes a region that was first mapped as background (the detector saw it late) the task's own.
    """
    if not region.any():
        return np.zeros_like(region)
    height, width = region.shape
    shape = (-(-height // _CELL_PX), -(-width // _CELL_PX))
    rows, columns = np.nonzero(region & (frame.depth_m > 0))
    wanted = _count(rows, columns, shape) / pixels_per_active
    _, held_rows, held_columns = visible_means(frame, active_means_m)
    held = _count(held_rows, held_columns, shape)
    lacking = np.repeat(np.repeat(held < wanted, _CELL_PX, axis=0), _CELL_PX, axis=1)[:height, :width]
    result: Bool[ndarray, "h w"] = lacking & region & (frame.depth_m > 0)
    return result


def visible_means(
    frame: Frame, means_m: Float32[ndarray, "n 3"]
) -> tuple[Int64[ndarray, " s"], Int64[ndarray, " s"], Int64[ndarray, " s"]]:
    """Which of the means lie on the surface that the frame sees (ascending), and their pixels' rows and columns."""
    points = transform_points(inverse(frame.T_world_camera), means_m)
    ids = np.flatnonzero(points[:, 2] > NEAR_M)
    points = points.take(ids, axis=0)
    x_px, y_px = np.ascontiguousarray(project(points, frame.camera).T)
    height, width = frame.depth_m.shape
    inside = np.flatnonzero((y_px >= 0) & (y_px < height) & (x_px >= 0) & (x_px < width))
    ids, z_m = ids[inside], points[inside, 2]
    rows, columns = y_px[inside].astype(np.int64), x_px[inside].astype(np.int64)
    depth_m = frame.depth_m[rows, columns]
    on_surface = np.abs(z_m - depth_m) < _SAME_SURFACE * depth_m
    return ids[on_surface], rows[on_surface], columns[on_surface]


def _count(rows: ndarray, columns: ndarray, shape: tuple[int, int]) -> ndarray:
    cells = (rows // _CELL_PX) * shape[1] + columns // _CELL_PX
    return np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)
