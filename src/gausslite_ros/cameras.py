"""Join colour and depth messages with the camera's pose to a frame: for bags and for live topics alike."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.datasets.camera_files import FolderCamera
from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, MissingPluginError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite_ros.messages import (
    CompressedImageMessage,
    decode_colour,
    decode_compressed_colour,
    decode_compressed_depth,
    decode_depth,
)


@dataclass(frozen=True, slots=True, eq=False)
class RgbdCamera:
    """The colour camera, and the depth camera if its images have to be registered.

    depth: None for depth images that are aligned to colour. T_colour_depth: p_colour = T_colour_depth @ p_depth.
    """

    colour: FolderCamera
    depth: FolderCamera | None
    T_colour_depth: Float64[ndarray, "4 4"]

    @classmethod
    def of(
        cls, colour: FolderCamera, depth: FolderCamera | None, T_colour_depth: Float64[ndarray, "4 4"]
    ) -> RgbdCamera:
        """Return the pair; depth with the colour camera's pose, size and intrinsics is aligned. depth None: aligned."""
        same_pose = np.allclose(T_colour_depth, np.eye(4), atol=1e-9)
        if depth is not None and same_pose and depth.camera == colour.camera:
            depth = None
        return cls(colour, depth, T_colour_depth)

    @property
    def camera(self) -> Camera:
        """Camera of the joined images."""
        return self.colour.camera

    @property
    def lens(self) -> Lens | None:
        """Lens of the joined images; None for registered ones, whose colour is undistorted."""
        return self.colour.lens if self.depth is None else None

    def join(self, location: str, rgb: UInt8[ndarray, "h w 3"], depth_m: Float32[ndarray, "hd wd"]) -> RgbdImage:
        """Return both images in the colour camera. Raises DatasetError with the location for images of other sizes."""
        depth_camera = self.colour if self.depth is None else self.depth
        _require_size(f"{location}: colour", rgb, self.camera)
        _require_size(f"{location}: depth", depth_m, depth_camera.camera)
        if self.depth is None:
            return RgbdImage(rgb, depth_m, self.camera)
        # most cameras align depth themselves
        try:
            from gausslite_calibration import corrected, registered
        except ModuleNotFoundError as error:
            raise MissingPluginError(
                "depth that is not aligned to colour: needs the package gausslite_calibration, which is not installed"
            ) from error
        if self.colour.lens is not None:
            rgb = corrected.undistort_colour(rgb, self.camera, self.colour.lens)
        if self.depth.lens is not None:
            depth_m = corrected.undistort_depth(depth_m, self.depth.camera, self.depth.lens)
        registered_m = registered.register_depth(depth_m, self.depth.camera, self.camera, self.T_colour_depth)
        return RgbdImage(rgb, registered_m, self.camera)


def _require_size(location: str, image: ndarray, camera: Camera) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        expected = f"{camera.width_px}x{camera.height_px}"
        raise DatasetError(f"{location}: expected the size of its camera_info, {expected}, got {width}x{height}")


_BODY_TO_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_body_optical: a body's axes point forward, left and up; an optical frame's right, down and forward (REP 103)."""


def join_cameras(
    colour: FolderCamera, depth: FolderCamera | None, T_colour_depth: Float64[ndarray, "4 4"], axes: str
) -> RgbdCamera:
    """Return the pair of cameras; depth None: aligned. axes: convention of the transform, "optical" or "body"."""
    if axes == "body":
        T_colour_depth = _BODY_TO_OPTICAL.T @ T_colour_depth @ _BODY_TO_OPTICAL
    return RgbdCamera.of(colour, depth, T_colour_depth)


def require_own_camera(
    location: str, colour: FolderCamera, depth: FolderCamera, T_colour_depth: Float64[ndarray, "4 4"]
) -> None:
    """Raise DatasetError for a depth camera beside colour with exactly its intrinsics: such depth may be aligned."""
    beside_m = float(np.linalg.norm(T_colour_depth[:3, 3]))
    if (depth.camera, depth.lens) == (colour.camera, colour.lens) and beside_m > 0:
        raise DatasetError(
            f"{location}: has the intrinsics of colour and the frame of a camera {1000 * beside_m:.0f} mm beside it; "
            "is this depth aligned to colour? State aligned=yes or aligned=no"
        )


_SAME_CAMERA = 0.005
"""Intrinsics that differ by a smaller share, as by autofocus, count as equal."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPeriods:
    """The cameras that a topic of camera_info states over time; starts_ns: when each begins, ascending."""

    topic: str
    starts_ns: Sequence[int]
    cameras: Sequence[FolderCamera]

    def is_first(self, time_ns: int) -> bool:
        """True if the camera at this time is that of the start."""
        return same_camera(self.cameras[0], self.cameras[max(bisect_right(self.starts_ns, time_ns) - 1, 0)])

    def __str__(self) -> str:
        """Return the first camera and the first other one."""
        other = next(camera for camera in self.cameras if not same_camera(self.cameras[0], camera))
        texts = (
            f"{found.camera.width_px}x{found.camera.height_px} with fx {found.camera.fx_px:.1f}, lens {found.lens}"
            for found in (self.cameras[0], other)
        )
        return f"{self.topic} states {' and later '.join(texts)}; record each camera as a bag of its own"


def same_camera(a: FolderCamera, b: FolderCamera) -> bool:
    """Return True for cameras of one size and lens with nearly equal intrinsics."""
    return a.lens == b.lens and np.allclose(astuple(a.camera), astuple(b.camera), rtol=_SAME_CAMERA)


def optical_pose(T_world_camera: Float64[ndarray, "4 4"], axes: str) -> Float64[ndarray, "4 4"]:
    """Return the pose with optical axes of a camera frame whose axes are "optical" or "body"."""
    return T_world_camera @ _BODY_TO_OPTICAL if axes == "body" else T_world_camera


@dataclass(frozen=True, slots=True, eq=False)
class FrameConverter:
    """The cameras of a colour and a depth topic, and the units per metre of depth; None: those of its encoding."""

    cameras: RgbdCamera
    colour_topic: str
    depth_topic: str
    units_per_metre: float | None

    def frame(
        self,
        location: str,
        number: int,
        messages: tuple[Any, Any],
        stamp_ns: int,
        T_world_camera: Float64[ndarray, "4 4"],
        size: tuple[int, int] | None = None,
    ) -> Frame:
        """Return the frame of the colour and the depth message, resized. Raises DatasetError with the location."""
        location = f"{location}: message at {stamp_ns / 1e9:.9f} s"
        rgb = _colour_image(f"{location}: {self.colour_topic}", messages[0])
        depth_m = _depth_image(f"{location}: {self.depth_topic}", messages[1], self.units_per_metre)
        image = resize_rgbd(self.cameras.join(location, rgb, depth_m), size)
        # to the precision of a float64 in seconds, as in folders: keyframes are chosen by their times
        return image.frame(number, round(stamp_ns / 10**9 * 1e9), T_world_camera)


def _colour_image(location: str, message: Any) -> UInt8[ndarray, "h w 3"]:
    compressed = isinstance(message, CompressedImageMessage)
    return decode_compressed_colour(location, message) if compressed else decode_colour(location, message)


def _depth_image(location: str, message: Any, units_per_metre: float | None) -> Float32[ndarray, "h w"]:
    compressed = isinstance(message, CompressedImageMessage)
    return (decode_compressed_depth if compressed else decode_depth)(location, message, units_per_metre)
