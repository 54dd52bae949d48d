"""Turn recorded images into those of an ideal camera: no lens distortion, all rows exposed at one time.

Each output pixel looks up the recorded image once. The recorded row's exposure time depends on the row that is looked
up, so the lookup is solved by fixed-point iteration. Colour is interpolated; depth takes the nearest pixel, since an
interpolated depth lies on no surface.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.camera import MAX_READOUT_S, Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Trajectory, Twist, inverse, twist_of
from gausslite.domain.recording import CameraCorrection

_FIXED_POINT_STEPS = 3
_GRID_PX = 4
_MIN_DEPTH_M = 0.05
_SAMPLES, _SLOPE_STEP = 17, 1e-5


def ideal_camera(camera: Camera, correction: CameraCorrection, angular_speed_rad_s: float) -> Camera:
    """Return the pinhole camera of the corrected images, of the same size.

    Its field of view is the largest in which every pixel has a recorded value while the camera turns at up to this
    angular speed: lookups move by at most half a readout of motion.
    """
    if correction.lens is not None and not correction.lens.is_identity:
        camera = _undistorted(camera, correction.lens)
    swing_rad = 0.5 * abs(correction.readout_s) * angular_speed_rad_s
    width_px, height_px = camera.width_px, camera.height_px
    margin_px = math.ceil(camera.length_px(swing_rad, 1.0))
    if margin_px == 0:
        return camera
    inner = camera.cropped(margin_px, margin_px, max(width_px - 2 * margin_px, 1), max(height_px - 2 * margin_px, 1))
    return inner.resized(width_px, height_px)


def correct_frame(frame: Frame, correction: CameraCorrection, ideal: Camera, twist: Twist) -> Frame:
    """Return the frame as the ideal camera would have recorded it at the time of its middle row.

    Pixels that the recorded image does not show repeat its border and have no depth. The twist is that of the camera
    at the frame's stamp. Motion blur stays; the frame's motion states it.
    """
    T_world_camera = frame.T_world_camera @ twist.motion(correction.time_offset_s)
    motion = CameraMotion(twist, exposure_s=correction.exposure_s) if correction.exposure_s else None
    has_lens = correction.lens is not None and not correction.lens.is_identity
    if not has_lens and correction.readout_s == 0.0 and ideal == frame.camera:
        # each pixel looks up itself
        return replace(frame, T_world_camera=T_world_camera, motion=motion)
    depth_m = np.zeros_like(frame.depth_m)
    columns, rows = recorded_pixels(frame.camera, correction, ideal, twist, depth_m)
    if correction.readout_s != 0.0 and np.any(twist.linear_m_s):
        # depth decides how far the translation moves a pixel; rotation alone is close enough to look it up
        depth_m = cv2.remap(frame.depth_m, columns, rows, cv2.INTER_NEAREST)
        columns, rows = recorded_pixels(frame.camera, correction, ideal, twist, depth_m)
    return replace(
        frame,
        rgb=cv2.remap(frame.rgb, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE),
        depth_m=cv2.remap(frame.depth_m, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT),
        camera=ideal,
        T_world_camera=T_world_camera,
        motion=motion,
    )


def undistort_frame(frame: Frame, correction: CameraCorrection, ideal: Camera, twist: Twist) -> Frame:
    """Return the frame without lens distortion and time offset, at the pose of its middle row.

    Rolling shutter and motion blur stay in the image: the frame's motion states them. ideal: `ideal_camera` of the
    correction without its readout time. The twist is that of the camera at the frame's stamp.
    """
    has_lens = correction.lens is not None and not correction.lens.is_identity
    undistorted = correct_frame(frame, CameraCorrection(correction.lens), ideal, twist) if has_lens else frame
    first, last = _recorded_row_shares(frame.camera, correction.lens, ideal)
    readout_s = min(max(correction.readout_s * (last - first), -MAX_READOUT_S), MAX_READOUT_S)
    middle_s = correction.time_offset_s + correction.readout_s * (0.5 * (first + last) - 0.5)
    motion = CameraMotion(twist, readout_s, correction.exposure_s)
    return replace(
        undistorted,
        T_world_camera=frame.T_world_camera @ twist.motion(middle_s),
        motion=None if motion.is_still else motion,
    )


def _recorded_row_shares(recorded: Camera, lens: Lens | None, ideal: Camera) -> tuple[float, float]:
    """Return the recorded rows at the upper and lower border of an undistorted image, 0 to 1, in its middle column.

    Rows in between are nearly linear: distortion bends them by a few pixels, which the readout passes in microseconds.
    """
    x, y = ideal.slopes(np.full(2, 0.5 * ideal.width_px), np.array([0.0, ideal.height_px]))
    first, last = (_pixels(x, y, recorded, lens)[1] + 0.5) / recorded.height_px
    return float(first), float(last)


def undistort_colour(rgb: UInt8[ndarray, "h w 3"], camera: Camera, lens: Lens) -> UInt8[ndarray, "h w 3"]:
    """Return the image as a pinhole camera with these intrinsics would have recorded it; borders are repeated."""
    columns, rows = _pinhole_lookup(camera, lens)
    undistorted: UInt8[ndarray, "h w 3"] = cv2.remap(
        rgb, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return undistorted


def undistort_depth(depth_m: Float32[ndarray, "h w"], camera: Camera, lens: Lens) -> Float32[ndarray, "h w"]:
    """Return the depth image as a pinhole camera with these intrinsics would have recorded it, by nearest pixel."""
    columns, rows = _pinhole_lookup(camera, lens)
    undistorted: Float32[ndarray, "h w"] = cv2.remap(
        depth_m, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
    )
    return undistorted


def _pinhole_lookup(camera: Camera, lens: Lens) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    still = Twist(np.zeros(3), np.zeros(3))
    no_depth = np.zeros((camera.height_px, camera.width_px), np.float32)
    return recorded_pixels(camera, CameraCorrection(lens), camera, still, no_depth)


def _undistorted(camera: Camera, lens: Lens) -> Camera:
    """Return the pinhole camera whose whole image the distorted image covers. Raises InvalidInputError."""
    size = camera.width_px, camera.height_px
    K = camera.opencv_matrix
    D = np.array(lens.coefficients)
    try:
        if lens.model is LensModel.FISHEYE:
            K_ideal = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, D, size, np.eye(3), balance=0.0)
        else:
            K_ideal, _ = cv2.getOptimalNewCameraMatrix(K, D, size, 0.0)
        ideal = camera.with_opencv_matrix(K_ideal)
        _require_invertible(lens, ideal)
        return ideal
    except (cv2.error, InvalidInputError) as error:
        raise InvalidInputError(f"lens {lens}: expected one that can be inverted over the image") from error


def _require_invertible(lens: Lens, camera: Camera) -> None:
    """Raise InvalidInputError if the lens folds the image of this pinhole camera, by its Jacobian at sampled points."""
    columns, rows = np.linspace(0, camera.width_px, _SAMPLES), np.linspace(0, camera.height_px, _SAMPLES)
    x, y = np.meshgrid(*camera.slopes(columns, rows))
    h = _SLOPE_STEP
    right, left, below, above = (lens.distort(x + dx, y + dy) for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h)))
    determinant = (right[0] - left[0]) * (below[1] - above[1]) - (below[0] - above[0]) * (right[1] - left[1])
    if not (determinant > 0).all():
        raise InvalidInputError(f"lens {lens}: expected one that does not fold the image")


def recorded_pixels(
    recorded: Camera, correction: CameraCorrection, ideal: Camera, twist: Twist, depth_m: Float32[ndarray, "h w"]
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return column and row of the recorded image for every ideal pixel, counted from pixel centres at integers.

    depth_m: of the ideal image, 0 where it is unknown and the camera's translation is ignored.
    A point p of the camera at the middle row's time has moved to p - dt (w × p + v) after dt. The lookup is solved on
    a grid of every _GRID_PX-th pixel and interpolated in between: it is smooth, and this takes a fraction of the time.
    """
    height, width = ideal.height_px, ideal.width_px
    grid_rows, grid_columns = np.arange(0, height + _GRID_PX, _GRID_PX), np.arange(0, width + _GRID_PX, _GRID_PX)
    x, y = ideal.slopes((grid_columns + 0.5)[None, :], (grid_rows + 0.5)[:, None])
    z_m = depth_m[np.minimum(grid_rows, height - 1)[:, None], np.minimum(grid_columns, width - 1)[None, :]]
    inverse_z = np.where(z_m > 0, 1.0 / np.maximum(z_m, _MIN_DEPTH_M), 0.0)
    (wx, wy, wz), (vx, vy, vz) = twist.angular_rad_s, twist.linear_m_s
    dx, dy = wy - wz * y + vx * inverse_z, wz * x - wx + vy * inverse_z
    dz = wx * y - wy * x + vz * inverse_z
    dt_s = np.zeros_like(inverse_z, np.float64)
    for _ in range(_FIXED_POINT_STEPS if correction.readout_s != 0.0 else 1):
        scale = 1.0 / (1.0 - dt_s * dz)
        columns, rows = _pixels((x - dt_s * dx) * scale, (y - dt_s * dy) * scale, recorded, correction.lens)
        dt_s = correction.readout_s * (np.clip((rows + 0.5) / height, 0.0, 1.0) - 0.5)
    return _interpolated(columns, width, height), _interpolated(rows, width, height)


def _pixels(x: ndarray, y: ndarray, camera: Camera, lens: Lens | None) -> tuple[ndarray, ndarray]:
    if lens is not None:
        x, y = lens.distort(x, y)
    columns, rows = camera.pixels(x, y)
    return columns - 0.5, rows - 0.5


def _interpolated(grid: Float64[ndarray, "m n"], width: int, height: int) -> Float32[ndarray, "h w"]:
    """Return a value for every pixel, bilinear between the grid's pixels."""
    at_columns, at_rows = _grid_coordinates(width, height)
    values: Float32[ndarray, "h w"] = cv2.remap(grid.astype(np.float32), at_columns, at_rows, cv2.INTER_LINEAR)
    return values


@lru_cache(maxsize=4)
def _grid_coordinates(width: int, height: int) -> list[Float32[ndarray, "h w"]]:
    """Return column and row of every pixel in the grid."""
    sides = (np.arange(side, dtype=np.float32) / np.float32(_GRID_PX) for side in (width, height))
    return list(np.meshgrid(*sides))


_MAX_VELOCITY_CHANGE, _LEAST_GAP_S, _TYPICAL_DISTANCE_M = 0.5, 1e-6, 2.0


def is_steady(trajectory: Trajectory, i: int) -> bool:
    """True if the velocities before and after pose i are similar: only then do poses state the velocity there."""
    times_s, T = trajectory.times_s, trajectory.T_world_camera
    if not 0 < i < len(times_s) - 1:
        return False
    before, after = (
        twist_of(inverse(T[k]) @ T[k + 1]) / max(float(times_s[k + 1] - times_s[k]), _LEAST_GAP_S) for k in (i - 1, i)
    )
    change, mean = after - before, 0.5 * (before + after)
    limit = _MAX_VELOCITY_CHANGE * typical_image_speed(Twist(mean[:3], mean[3:]))
    return typical_image_speed(Twist(change[:3], change[3:])) <= limit


def typical_image_speed(twist: Twist) -> float:
    """Return the image motion in focal lengths per second, of a point at a distance of 2 m."""
    return float(np.linalg.norm(twist.angular_rad_s) + np.linalg.norm(twist.linear_m_s) / _TYPICAL_DISTANCE_M)


_SPEED_QUANTILE = 0.9
"""Frames that turn faster than this share of all frames repeat the image's border in a few pixels."""


class CorrectedSource(WrappedSource):
    """A source without lens distortion and time offset; each frame's motion states rolling shutter and motion blur.

    rectified: also remove the rolling shutter, as if all rows were exposed at once. Comparisons of frames with each
    other need this. The rasterizer models the shutter itself, which is sharper and keeps the field of view.
    Colour and depth are undistorted alike, so depth must be registered to colour. A source without correction returns
    its frames unchanged. Raises InvalidInputError.
    """

    def __init__(self, source: Source, correction: CameraCorrection, rectified: bool = False) -> None:
        super().__init__(source)
        self._correction, self._rectified = correction, rectified
        self._trajectory = source.trajectory()
        if not rectified:
            self._camera = ideal_camera(source.camera, replace(correction, readout_s=0.0), 0.0)
            return
        speeds_rad_s = self._trajectory.angular_speeds_rad_s() if correction.readout_s != 0.0 else np.zeros(1)
        self._camera = ideal_camera(source.camera, correction, float(np.quantile(speeds_rad_s, _SPEED_QUANTILE)))

    def rectified(self) -> CorrectedSource:
        """Return the same source with its rolling shutter removed."""
        return CorrectedSource(self._source, self._correction, rectified=True)

    @property
    def camera(self) -> Camera:
        """The ideal camera, of the recorded images' size."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """None: frames are undistorted."""
        return None

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the corrected frame at position i. Raises DatasetError, PoseError."""
        # at full size: a resized image has lost the pixels that the lookup needs
        recorded = self._source.frame(i)
        correct = correct_frame if self._rectified else undistort_frame
        frame = correct(recorded, self._correction, self._camera, self._trajectory.twist(i))
        if frame.motion is not None and not is_steady(self._trajectory, i):
            # a blur along a wrong velocity does more harm than none
            frame = replace(frame, motion=replace(frame.motion, exposure_s=0.0))
        return resize_rgbd(RgbdImage(frame.rgb, frame.depth_m, frame.camera), size).in_frame(frame)

    def trajectory(self) -> Trajectory:
        """The wrapped source's trajectory, as recorded."""
        return self._trajectory


class UndistortedColourSource(WrappedSource):
    """A source whose stated lens is that of the colour camera alone. The colour images keep the stated intrinsics.

    Depth is registered to the undistorted images afterwards. A source without a lens returns its frames unchanged.
    """

    @property
    def lens(self) -> Lens | None:
        """None: colour is undistorted, and depth images of such sensors have no stated distortion."""
        return None

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i with undistorted colour. Raises DatasetError, PoseError."""
        lens = self._source.lens
        if lens is None:
            return self._source.frame(i, size)
        recorded = self._source.frame(i)
        rgb = undistort_colour(recorded.rgb, recorded.camera, lens)
        return resize_rgbd(RgbdImage(rgb, recorded.depth_m, recorded.camera), size).in_frame(recorded)
