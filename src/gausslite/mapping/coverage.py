"""Compare a frame with the map: pixels not explained yet, ROI pixels with too few Gaussians, visible Gaussians."""

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
_MAX_RELATIVE_DEPTH_ERROR = 0.05
"""A Gaussian within this fraction of the measured depth lies on the visible surface."""
_MEDIAN_STEP_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """The map rendered from a frame's pose: alpha in [0, 1], and expected depth in metres (0 where alpha is low)."""

    alpha: Float32[ndarray, "h w"]
    depth_m: Float32[ndarray, "h w"]

    @classmethod
    def from_rendering(cls, rendering: Rendering) -> RenderedView:
        """Return alpha and expected depth of a rendering."""
        return cls(rendering.alpha, rendering.expected_depth_m())


def rendered_behind(frame: Frame, rendered: RenderedView, depth_error_factor: float) -> Bool[ndarray, "h w"]:
    """Return the pixels rendered behind the measured depth by more than depth_error_factor times the median error.

    The median of the absolute depth error is taken over every fourth row and column.
    """
    comparable = (frame.depth_m > 0) & (rendered.depth_m > 0)
    behind_m = rendered.depth_m - frame.depth_m
    sample = (slice(None, None, _MEDIAN_STEP_PX), slice(None, None, _MEDIAN_STEP_PX))
    errors_m = np.abs(behind_m[sample][comparable[sample]])
    median_m = float(np.median(errors_m)) if len(errors_m) else 0.0
    result: Bool[ndarray, "h w"] = comparable & (behind_m > depth_error_factor * median_m)
    return result


def undersampled_roi(
    frame: Frame, roi: Bool[ndarray, "h w"], active_means_m: Float32[ndarray, "n 3"], pixels_per_gaussian: float
) -> Bool[ndarray, "h w"]:
    """Return ROI pixels in 8x8 cells with less than one active Gaussian per `pixels_per_gaussian` ROI pixels.

    These are mapped as background so far, for example because the detector found the object late.
    """
    if not roi.any():
        return np.zeros_like(roi)
    height, width = roi.shape
    shape = (-(-height // _CELL_PX), -(-width // _CELL_PX))
    rows, columns = np.nonzero(roi & (frame.depth_m > 0))
    min_count = _count_per_cell(rows, columns, shape) / pixels_per_gaussian
    _, active_rows, active_columns = visible_means(frame, active_means_m)
    count = _count_per_cell(active_rows, active_columns, shape)
    sparse = np.repeat(np.repeat(count < min_count, _CELL_PX, axis=0), _CELL_PX, axis=1)[:height, :width]
    result: Bool[ndarray, "h w"] = sparse & roi & (frame.depth_m > 0)
    return result


def visible_means(
    frame: Frame, means_m: Float32[ndarray, "n 3"]
) -> tuple[Int64[ndarray, " s"], Int64[ndarray, " s"], Int64[ndarray, " s"]]:
    """Return ids (ascending), pixel rows and pixel columns of the means that lie on the frame's visible surface."""
    points = transform_points(inverse(frame.T_world_camera), means_m)
    ids = np.flatnonzero(points[:, 2] > NEAR_M)
    points = points.take(ids, axis=0)
    if frame.motion is not None:
        points = frame.motion.at_exposure(points.astype(np.float64), frame.camera).astype(np.float32)
    x_px, y_px = np.ascontiguousarray(project(points, frame.camera).T)
    height, width = frame.depth_m.shape
    inside = np.flatnonzero((y_px >= 0) & (y_px < height) & (x_px >= 0) & (x_px < width))
    ids, z_m = ids[inside], points[inside, 2]
    rows, columns = y_px[inside].astype(np.int64), x_px[inside].astype(np.int64)
    depth_m = frame.depth_m[rows, columns]
    on_surface = np.abs(z_m - depth_m) < _MAX_RELATIVE_DEPTH_ERROR * depth_m
    return ids[on_surface], rows[on_surface], columns[on_surface]


def _count_per_cell(rows: ndarray, columns: ndarray, shape: tuple[int, int]) -> ndarray:
    cells = (rows // _CELL_PX) * shape[1] + columns // _CELL_PX
    return np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)
