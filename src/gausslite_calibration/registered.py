"""Register depth to the colour camera, for sensors with two separate cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, inverse
from gausslite.domain.recording import DepthRegistration

_MAX_ZOOM = 4.0
_BAND_ROWS = 40
# a slanted surface stretches between two views: enlarged footprints close the gaps
_OVERLAP = np.float32(1.1)
# upper bound of the footprint for surfaces much closer to the colour camera, which limits the passes
_MAX_SPREAD = np.float32(2.0)


class RegisteredSource(WrappedSource):
    """A source with its depth registered to the colour camera; poses become the colour camera's.

    The wrapped source's camera and poses are those of the depth camera. Raises InvalidInputError if the focal lengths
    differ by more than a factor of 4.
    """

    def __init__(self, source: Source, registration: DepthRegistration) -> None:
        super().__init__(source)
        depth_camera = source.camera
        self._camera = registration.camera(depth_camera.width_px, depth_camera.height_px)
        for axis in ("fx_px", "fy_px"):
            colour_px, depth_px = getattr(self._camera, axis), getattr(depth_camera, axis)
            if not depth_px / _MAX_ZOOM <= colour_px <= depth_px * _MAX_ZOOM:
                raise InvalidInputError(
                    f"depth registration {axis}: expected at most {_MAX_ZOOM:g} times more or less than "
                    f"the depth camera's {depth_px:g}, got {colour_px:g}"
                )
        self._T_colour_depth = registration.extrinsics()

    @property
    def camera(self) -> Camera:
        """Colour camera."""
        return self._camera

    @property
    def depth_registered(self) -> bool:
        """True."""
        return True

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i in the colour camera. Raises DatasetError, PoseError."""
        # register at full size: a resized depth image lacks the pixels that determine its edges
        recorded = self._source.frame(i)
        depth_m = register_depth(recorded.depth_m, recorded.camera, self._camera, self._T_colour_depth)
        moved = replace(recorded, T_world_camera=recorded.T_world_camera @ inverse(self._T_colour_depth))
        return resize_rgbd(RgbdImage(recorded.rgb, depth_m, self._camera), size).in_frame(moved)

    def trajectory(self) -> Trajectory:
        """Return the poses of the colour camera."""
        recorded = self._source.trajectory()
        return Trajectory(recorded.times_s, recorded.T_world_camera @ inverse(self._T_colour_depth))


def register_depth(
    depth_m: Float32[ndarray, "h w"],
    depth_camera: Camera,
    colour_camera: Camera,
    T_colour_depth: Float64[ndarray, "4 4"],
) -> Float32[ndarray, "hc wc"]:
    """Return the depth image in metres as the colour camera would measure it; 0 without a depth reading.

    Each depth pixel covers the colour pixels whose centres lie in its projected footprint, so magnification leaves no
    holes; the nearest surface wins. Pixels that only the colour camera sees stay 0.
    """
    nearest = np.full((colour_camera.height_px, colour_camera.width_px), np.inf, np.float32)
    # in bands, so that temporary arrays stay in the cache
    for first in range(0, len(depth_m), _BAND_ROWS):
        band_m = depth_m[first : first + _BAND_ROWS]
        band_camera = depth_camera.cropped(0, first, depth_camera.width_px, len(band_m))
        _splat(nearest, band_m, band_camera, colour_camera, T_colour_depth)
    nearest[np.isinf(nearest)] = 0.0
    return nearest


def _splat(
    nearest: Float32[ndarray, "hc wc"],
    depth_m: Float32[ndarray, "h w"],
    depth_camera: Camera,
    colour_camera: Camera,
    T_colour_depth: Float64[ndarray, "4 4"],
) -> None:
    """Set `nearest` to the minimum of itself and the depths of all footprints that cover a pixel's centre."""
    height, width = nearest.shape
    column_px, row_px, z_m = _project_image(depth_m, depth_camera, colour_camera, T_colour_depth)
    spread = np.minimum(_OVERLAP * depth_m / z_m, _MAX_SPREAD)
    width_px, height_px = (spread * np.float32(zoom) for zoom in colour_camera.magnification(depth_camera))
    left, top = column_px - 0.5 * width_px, row_px - 0.5 * height_px
    columns = [_pixels_covered(left, width_px, step, width) for step in range(_steps(width_px))]
    measured = z_m < np.inf
    for row_step in range(_steps(height_px)):
        row, in_row = _pixels_covered(top, height_px, row_step, height)
        in_row &= measured
        for column, in_column in columns:
            covered = np.flatnonzero(in_row & in_column)
            flat = row.take(covered).astype(np.int64) * width + column.take(covered).astype(np.int64)
            np.minimum.at(nearest.reshape(-1), flat, z_m.take(covered))


def _project_image(
    depth_m: Float32[ndarray, "h w"],
    depth_camera: Camera,
    colour_camera: Camera,
    T_colour_depth: Float64[ndarray, "4 4"],
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return column, row and depth of each depth pixel in the colour camera; infinite depth without a reading."""
    # separate coordinate planes are three times faster than an array of points
    height, width = depth_m.shape
    slopes = depth_camera.slopes((np.arange(width) + 0.5)[None, :], (np.arange(height) + 0.5)[:, None])
    x, y = (axis.astype(np.float32) for axis in slopes)
    T = T_colour_depth.astype(np.float32)
    x_m, y_m, z_m = ((T[i, 0] * x + T[i, 1] * y + T[i, 2]) * depth_m + T[i, 3] for i in range(3))
    z_m = np.where((depth_m > 0) & (z_m > 0), z_m, np.float32(np.inf))
    column_px, row_px = colour_camera.pixels(x_m / z_m, y_m / z_m)
    return column_px, row_px, z_m


def _steps(footprint_px: Float32[ndarray, "h w"]) -> int:
    """Return the maximum number of pixel centres in one footprint along an axis."""
    return int(np.ceil(footprint_px.max(initial=0.0)))


def _pixels_covered(
    low_px: Float32[ndarray, "h w"], footprint_px: Float32[ndarray, "h w"], step: int, count: int
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"]]:
    """Return the step-th pixel from the start of the footprint, and whether the footprint covers its centre."""
    pixel = np.ceil(low_px - 0.5) + np.float32(step)
    return pixel, (pixel + 0.5 < low_px + footprint_px) & (pixel >= 0) & (pixel < count)
