"""Bring depth into the colour camera, for sensors whose two cameras do not look through one lens."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.intrinsics import FileIntrinsics
from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis, inverse
from gausslite.domain.region import Region
from gausslite.errors import InvalidInputError

_MAX_BASELINE_M = 1.0
_MAX_TURN_DEG = 45.0
_MAX_ZOOM = 4.0
_BAND_ROWS = 40
# a slanted surface stretches between two views: neighbours reach over the gap
_OVERLAP = np.float32(1.1)
# what is this much nearer to the colour camera would cost more passes than it is worth
_MAX_SPREAD = np.float32(2.0)


@dataclass(frozen=True, slots=True)
class DepthRegistration:
    """The colour camera beside a depth camera, both looking about the same way.

    intrinsics as data sets write them (pixel centres at integers), for images of the sequence's own size. offset_m
    is the translation of T_colour_depth, where the depth camera sits seen from the colour camera; turn_deg its
    rotation vector, the axis times the angle.
    """

    intrinsics: FileIntrinsics
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        fx, fy, cx, cy = self.intrinsics.fx, self.intrinsics.fy, self.intrinsics.cx, self.intrinsics.cy
        if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx <= 0 or fy <= 0:
            came = f"{fx:g},{fy:g},{cx:g},{cy:g}"
            raise InvalidInputError(
                f"colour camera: expected finite FX,FY,CX,CY with focal lengths above 0, got {came}"
            )
        if not all(abs(value) <= _MAX_BASELINE_M for value in self.offset_m):
            came = ",".join(f"{value:g}" for value in self.offset_m)
            raise InvalidInputError(
                f"colour camera: expected TX,TY,TZ in metres, at most {_MAX_BASELINE_M:g} each, got {came}"
            )
        if not math.hypot(*self.turn_deg) <= _MAX_TURN_DEG:
            came = ",".join(f"{value:g}" for value in self.turn_deg)
            raise InvalidInputError(
                f"colour camera: expected RX,RY,RZ, a turn of at most {_MAX_TURN_DEG:g} degrees, got {came}"
            )

    @classmethod
    def parse(cls, text: str) -> DepthRegistration:
        """Read FX,FY,CX,CY and perhaps TX,TY,TZ (metres) and RX,RY,RZ (degrees). Raises InvalidInputError."""
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (4, 7, 10):
            raise InvalidInputError(f"colour camera: expected FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]], got {text!r}")
        x, y, z, *turn = (*values[4:], *(0.0,) * (10 - len(values)))
        return cls(FileIntrinsics(*values[:4]), (x, y, z), (turn[0], turn[1], turn[2]))

    def __str__(self) -> str:
        """The text that `parse` reads."""
        k = self.intrinsics
        return ",".join(f"{value:.10g}" for value in (k.fx, k.fy, k.cx, k.cy, *self.offset_m, *self.turn_deg))

    def depth_to_colour(self) -> Float64[ndarray, "4 4"]:
        """T_colour_depth: takes points of the depth camera to the colour camera."""
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.radians(self.turn_deg))[0]
        T[:3, 3] = self.offset_m
        return T

    def enlarged(self, across: float, down: float) -> DepthRegistration:
        """The same camera for images so many times as wide and as high."""
        k = self.intrinsics
        cx, cy = (k.cx + 0.5) * across - 0.5, (k.cy + 0.5) * down - 0.5
        return replace(self, intrinsics=FileIntrinsics(k.fx * across, k.fy * down, cx, cy))

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Its Camera (pixel centres at +0.5)."""
        return self.intrinsics.camera("colour camera", width_px, height_px)


class RegisteredSource:
    """A source whose poses belong to its depth camera, seen from the colour camera beside it.

    Colour stays as it is; depth moves (`register_depth`), and the pose becomes the colour camera's. The wrapped
    source's own camera is taken for the depth camera's.
    """

    def __init__(self, source: Source, colour: DepthRegistration) -> None:
        self._source = source
        depth_camera = source.camera
        self._camera = colour.camera(depth_camera.width_px, depth_camera.height_px)
        for axis in ("fx_px", "fy_px"):
            here, there = getattr(self._camera, axis), getattr(depth_camera, axis)
            if not there / _MAX_ZOOM <= here <= there * _MAX_ZOOM:
                raise InvalidInputError(
                    f"colour camera {axis}: expected at most {_MAX_ZOOM:g} times more or less than "
                    f"the depth camera's {there:g}, got {here:g}"
                )
        self._T_colour_depth = colour.depth_to_colour()

    @property
    def name(self) -> str:
        """The wrapped source's name."""
        return self._source.name

    @property
    def camera(self) -> Camera:
        """The colour camera."""
        return self._camera

    @property
    def up_axis(self) -> UpAxis:
        """The wrapped source's; the world is the same."""
        return self._source.up_axis

    @property
    def depth_registered(self) -> bool:
        """True now."""
        return True

    @property
    def excluded_frames(self) -> str:
        """The wrapped source's."""
        return self._source.excluded_frames

    def __len__(self) -> int:
        return len(self._source)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """The frame at position i in the colour camera. Raises DatasetError, PoseError."""
        # register at full size: a resized depth image has lost the pixels that decide where an edge falls
        seen = self._source.frame(i)
        depth_m = register_depth(seen.depth_m, seen.camera, self._camera, self._T_colour_depth)
        image = resize_rgbd(RgbdImage(seen.rgb, depth_m, self._camera), size)
        T_world_colour = seen.T_world_camera @ inverse(self._T_colour_depth)
        return replace(seen, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera, T_world_camera=T_world_colour)

    def indices(self) -> Sequence[int]:
        """The wrapped source's frame numbers."""
        return self._source.indices()

    def regions(self) -> Mapping[str, Region]:
        """The wrapped source's; regions are of the world."""
        return self._source.regions()


def register_depth(
    depth_m: Float32[ndarray, "h w"],
    depth_camera: Camera,
    colour_camera: Camera,
    T_colour_depth: Float64[ndarray, "4 4"],
) -> Float32[ndarray, "hc wc"]:
    """The depth image as the colour camera would measure it, in metres; 0 where depth saw nothing.

    Every depth pixel covers the pixels of the colour image whose centres lie in its footprint there, so that
    enlarging leaves no holes; the nearest surface wins. What only the colour camera sees stays empty.
    """
    nearest = np.full((colour_camera.height_px, colour_camera.width_px), np.inf, np.float32)
    # band by band: what a band needs on the way stays in the processor's cache
    for first in range(0, len(depth_m), _BAND_ROWS):
        band_m = depth_m[first : first + _BAND_ROWS]
        band_camera = replace(depth_camera, cy_px=depth_camera.cy_px - first, height_px=len(band_m))
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
    """Lower `nearest` to the depth of every footprint that covers a pixel's centre."""
    height, width = nearest.shape
    column_px, row_px, z_m = _project_image(depth_m, depth_camera, colour_camera, T_colour_depth)
    spread = np.minimum(_OVERLAP * depth_m / z_m, _MAX_SPREAD)
    wide = spread * np.float32(colour_camera.fx_px / depth_camera.fx_px)
    high = spread * np.float32(colour_camera.fy_px / depth_camera.fy_px)
    left, top = column_px - 0.5 * wide, row_px - 0.5 * high
    for row_step in range(_steps(high)):
        row, in_row = _pixels_covered(top, high, row_step, height)
        for column_step in range(_steps(wide)):
            column, in_column = _pixels_covered(left, wide, column_step, width)
            covered = np.flatnonzero(in_row & in_column & (z_m < np.inf))
            flat = row.take(covered).astype(np.int64) * width + column.take(covered).astype(np.int64)
            np.minimum.at(nearest.reshape(-1), flat, z_m.take(covered))


def _project_image(
    depth_m: Float32[ndarray, "h w"],
    depth_camera: Camera,
    colour_camera: Camera,
    T_colour_depth: Float64[ndarray, "4 4"],
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Where each depth pixel's centre falls in the colour image (column, row), and its depth there.

    The depth is infinite where there is no return, and for points behind the colour camera.
    """
    # plane by plane: three times faster than an array of points
    height, width = depth_m.shape
    x = ((np.arange(width) + 0.5 - depth_camera.cx_px) / depth_camera.fx_px).astype(np.float32)[None, :]
    y = ((np.arange(height) + 0.5 - depth_camera.cy_px) / depth_camera.fy_px).astype(np.float32)[:, None]
    T = T_colour_depth.astype(np.float32)
    x_m, y_m, z_m = ((T[i, 0] * x + T[i, 1] * y + T[i, 2]) * depth_m + T[i, 3] for i in range(3))
    z_m = np.where((depth_m > 0) & (z_m > 0), z_m, np.float32(np.inf))
    column_px = x_m / z_m * np.float32(colour_camera.fx_px) + np.float32(colour_camera.cx_px)
    row_px = y_m / z_m * np.float32(colour_camera.fy_px) + np.float32(colour_camera.cy_px)
    return column_px, row_px, z_m


def _steps(footprint_px: Float32[ndarray, "h w"]) -> int:
    """The most pixel centres that one footprint can hold along an axis."""
    return int(np.ceil(footprint_px.max(initial=0.0)))


def _pixels_covered(
    low_px: Float32[ndarray, "h w"], footprint_px: Float32[ndarray, "h w"], step: int, count: int
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"]]:
    """The step-th pixel along an axis whose centre is not before the footprint's start, and whether it is covered."""
    pixel = np.ceil(low_px - 0.5) + np.float32(step)
    return pixel, (pixel + 0.5 < low_px + footprint_px) & (pixel >= 0) & (pixel < count)
