"""Input checks that all backends share, so that all raise the same errors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import ROW_WIDTH, TILE_PX, Rendering, Subset, UpdateCounter


def require_table(name: str, table: Float32[ndarray, "n 16"], n: int | None = None) -> None:
    """Raise ShapeError unless the table is contiguous with 16 columns (and n rows, if given)."""
    require_array(name, table, (n, ROW_WIDTH), np.float32)
    if not table.flags.c_contiguous:
        raise ShapeError(f"{name}: expected contiguous rows, got strides {table.strides}")


def require_tables(
    rows: Float32[ndarray, "n 16"], first_moment: Float32[ndarray, "n 16"], second_moment: Float32[ndarray, "n 16"]
) -> None:
    """Raise ShapeError unless the three tables have equal shapes and are writeable."""
    for name, table in (("rows", rows), ("first_moment", first_moment), ("second_moment", second_moment)):
        require_table(name, table, len(rows))
        if not table.flags.writeable:
            raise ShapeError(f"{name}: expected a writeable array, got a read-only one")


def require_scene(n: int, camera: Camera, T_camera_world: Float64[ndarray, "4 4"], subset: Subset) -> None:
    """Raise ShapeError unless pose and subset fit the camera, InvalidInputError unless ids are ascending."""
    require_array("T_camera_world", T_camera_world, (4, 4), np.float64)
    if subset.tiles is not None:
        grid = (-(-camera.height_px // TILE_PX), -(-camera.width_px // TILE_PX))
        require_array("subset tiles", subset.tiles, grid, np.bool_)
    if subset.ids is not None:
        require_array("subset ids", subset.ids, (None,), np.uint32)
        _require_ascending(subset.ids, n)


def require_row_masks(n: int, trainable: Bool[ndarray, " n"] | None, update_counter: UpdateCounter | None) -> None:
    """Raise ShapeError unless masks and counters have length n and the counters are writeable."""
    if trainable is not None:
        require_array("trainable", trainable, (n,), np.bool_)
    if update_counter is None:
        return
    require_array("update_counter counts", update_counter.counts, (n,), np.uint32)
    if not (update_counter.counts.flags.writeable and update_counter.counts.flags.c_contiguous):
        raise ShapeError("update_counter counts: expected a contiguous, writeable array, got another")
    if update_counter.mask is not None:
        require_array("update_counter mask", update_counter.mask, (n,), np.bool_)


def require_image_gradients(
    rendering: Rendering,
    d_rgb: Float32[ndarray, "h w 3"],
    d_depth_m: Float32[ndarray, "h w"],
    d_alpha: Float32[ndarray, "h w"],
) -> None:
    """Raise ShapeError unless the derivatives have the shapes of the rendered images."""
    size = rendering.alpha.shape
    require_array("d_rgb", d_rgb, (*size, 3), np.float32)
    require_array("d_depth_m", d_depth_m, size, np.float32)
    require_array("d_alpha", d_alpha, size, np.float32)


def require_view(
    rgb: UInt8[ndarray, "h w 3"],
    depth_m: Float32[ndarray, "h w"],
    camera: Camera,
    pixel_weights: Float32[ndarray, "h w"] | None,
) -> None:
    """Raise ShapeError unless the images have the camera's size; InvalidInputError if a weight is outside [0, 1]."""
    size = (camera.height_px, camera.width_px)
    require_array("view rgb", rgb, (*size, 3), np.uint8)
    require_array("view depth_m", depth_m, size, np.float32)
    if pixel_weights is not None:
        require_array("view pixel_weights", pixel_weights, size, np.float32)
        if not ((pixel_weights >= 0.0) & (pixel_weights <= 1.0)).all():
            raise InvalidInputError(
                f"view pixel_weights: expected values in [0, 1], got {pixel_weights.min()} to {pixel_weights.max()}"
            )


def _require_ascending(ids: UInt32[ndarray, " m"], n: int) -> None:
    if len(ids) and (ids[-1] >= n or (ids[1:] <= ids[:-1]).any()):
        raise InvalidInputError(f"subset ids: expected ascending row numbers below {n}, got others")
