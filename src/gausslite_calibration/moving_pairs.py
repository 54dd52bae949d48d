"""Pairs of frames on moving stretches, and how far they disagree under a camera correction.

A frame is warped into a later one by depth and both poses, and the later frame's pose is fitted to the result. A wrong
lens or wrong times leave a photometric residual, and a rotation that the fit needs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, usable_frames
from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, inverse, transform_points, twist_of
from gausslite.domain.recording import HANDHELD_PRIOR, CameraCorrection
from gausslite.render.rasterizer import NEAR_M, Rendering
from gausslite_calibration.corrected import correct_frame
from gausslite_calibration.registered import register_depth
from gausslite_poses.photometric import (
    MAX_PIXELS,
    MAX_RELATIVE_DEPTH_ERROR,
    comparable_pixels,
    fit_pose,
    luminance_residual,
)


@dataclass(frozen=True, slots=True, eq=False)
class FrameWarp:
    """For every pixel of a view: the pixel of a frame that shows the same surface, and the surface's depth in the view.

    columns, rows: counted from pixel centres at integers. alpha: 1 where the frame shows the surface, else 0.
    """

    columns: Float32[ndarray, "h w"]
    rows: Float32[ndarray, "h w"]
    depth_m: Float32[ndarray, "h w"]
    alpha: Float32[ndarray, "h w"]

    @classmethod
    def of(cls, frame: Frame, other: Frame) -> FrameWarp:
        """Return the warp of the frame into the other's view."""
        T_other_frame = inverse(other.T_world_camera) @ frame.T_world_camera
        depth_m = register_depth(frame.depth_m, frame.camera, other.camera, T_other_frame)
        points = transform_points(inverse(T_other_frame), back_project(depth_m, other.camera).reshape(-1, 3))
        z_m = np.maximum(points[:, 2], NEAR_M)
        # pixel centres at integers, as in cv2.remap
        columns, rows = (axis - 0.5 for axis in frame.camera.pixels(points[:, 0] / z_m, points[:, 1] / z_m))
        columns, rows, z_m = (values.reshape(depth_m.shape) for values in (columns, rows, z_m))
        depth_error_m = np.abs(cv2.remap(frame.depth_m, columns, rows, cv2.INTER_NEAREST) - z_m)
        alpha = ((depth_m > 0) & (depth_error_m < MAX_RELATIVE_DEPTH_ERROR * depth_m)).astype(np.float32)
        return cls(columns, rows, depth_m * alpha, alpha)

    def apply(self, image: ndarray) -> ndarray:
        """Return an image of the frame as the view shows it."""
        return cv2.remap(image, self.columns, self.rows, cv2.INTER_LINEAR)

    def rendering(self, frame: Frame) -> Rendering:
        """Return the frame as the view shows it, as a map would be rendered there."""
        rgb = self.apply(frame.rgb).astype(np.float32) / np.float32(255.0)
        return Rendering(rgb, self.depth_m, self.alpha, None)


def warp_into(frame: Frame, other: Frame) -> Rendering:
    """Return the frame as the other's camera would see it."""
    return FrameWarp.of(frame, other).rendering(frame)


_MAX_PAIRS = 16
MIN_COMPARABLE_SHARE = 0.08
"""Share of the pixels of the grid of `comparable_pixels`; less overlap makes the pose fit unreliable."""
_MIN_SPEED_RAD_S = math.radians(8.0)
"""Slower cameras move rows by less than a pixel in a readout of 30 ms."""
_MIN_HALVED_PIXELS = 160 * 120
_PAIR_ROTATION_RAD = math.radians(8.0)


@dataclass(frozen=True, slots=True)
class PairError:
    """Disagreement of frame pairs: robust residual of the luminance (0 to 255), and rotation of the pose fit.

    The rotation is the root of the mean square: wrong times turn each pair in proportion, so that its square is a
    parabola over the readout time and the offset.
    """

    residual: float
    rotation_deg: float
    pairs: int


@dataclass(frozen=True, slots=True, eq=False)
class MovingPairs:
    """Pairs of positions with their recorded frames, and the poses of the whole source; the errors are kept."""

    trajectory: Trajectory
    pairs: Sequence[tuple[int, int]]
    frames: Mapping[int, Frame]
    _errors: dict[CameraCorrection, PairError] = field(default_factory=dict)

    @classmethod
    def read(cls, source: Source, size: tuple[int, int]) -> MovingPairs:
        """Read the pairs of a source at this size; frames that cannot be read are absent."""
        trajectory = source.trajectory()
        pairs = fastest_pairs(trajectory)
        return cls(trajectory, pairs, dict(usable_frames(source, sorted({i for pair in pairs for i in pair}), size)))

    def halved(self) -> MovingPairs:
        """Return the pairs with frames of half the width and height, for a coarse search in a third of the time.

        Small frames are kept: below about 160x120 the residual no longer shows the readout time.
        """
        if any(frame.depth_m.size < 4 * _MIN_HALVED_PIXELS for frame in self.frames.values()):
            return self
        frames = {}
        for i, frame in self.frames.items():
            size = max(frame.camera.width_px // 2, 16), max(frame.camera.height_px // 2, 16)
            image = resize_rgbd(RgbdImage(frame.rgb, frame.depth_m, frame.camera), size)
            frames[i] = replace(frame, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera)
        return MovingPairs(self.trajectory, self.pairs, frames)

    def error(self, correction: CameraCorrection) -> PairError:
        """Return how far the pairs disagree once corrected, each after a fit of pose and exposure.

        The camera of the corrected images does not depend on the correction, so that residuals can be compared.
        """
        if correction not in self._errors:
            self._errors[correction] = self._error(correction)
        return self._errors[correction]

    def _error(self, correction: CameraCorrection) -> PairError:
        corrected = {
            i: correct_frame(frame, correction, frame.camera, self.trajectory.twist(i))
            for i, frame in self.frames.items()
        }
        residuals, rotations_deg = [], []
        for i, j in self.pairs:
            first, second = corrected.get(i), corrected.get(j)
            if first is None or second is None:
                continue
            warped = warp_into(first, second)
            if len(comparable_pixels(warped, second)) < MIN_COMPARABLE_SHARE * min(warped.alpha.size, MAX_PIXELS):
                continue
            T_world_fitted = fit_pose(warped, inverse(second.T_world_camera), second, HANDHELD_PRIOR)
            residuals.append(255.0 * luminance_residual(warped, second, T_world_fitted))
            change = twist_of(inverse(second.T_world_camera) @ T_world_fitted)
            rotations_deg.append(math.degrees(float(np.linalg.norm(change[3:]))))
        if not residuals:
            return PairError(math.inf, math.inf, 0)
        rotation_deg = math.sqrt(float(np.mean(np.square(rotations_deg))))
        return PairError(float(np.mean(residuals)), rotation_deg, len(residuals))


def fastest_pairs(trajectory: Trajectory) -> list[tuple[int, int]]:
    """Return positions of frame pairs on the fastest stretches; the second is rotated by about 8 degrees."""
    speeds = trajectory.angular_speeds_rad_s()
    separation = max(1, len(speeds) // (2 * _MAX_PAIRS))
    pairs: list[tuple[int, int]] = []
    for i in np.argsort(-speeds).tolist():
        if len(pairs) == _MAX_PAIRS or speeds[i] < _MIN_SPEED_RAD_S:
            break
        if all(abs(i - first) >= separation for first, _ in pairs):
            second = _first_rotated(trajectory, i)
            if second is not None:
                pairs.append((i, second))
    return pairs


def _first_rotated(trajectory: Trajectory, i: int) -> int | None:
    """Return the first later position that is rotated enough; the last one if none is; None without a later one."""
    R_world_first = trajectory.T_world_camera[i][:3, :3]
    for j in range(i + 1, len(trajectory.times_s)):
        rotation = cv2.Rodrigues(R_world_first.T @ trajectory.T_world_camera[j][:3, :3])[0]
        if np.linalg.norm(rotation) >= _PAIR_ROTATION_RAD:
            return j
    return len(trajectory.times_s) - 1 if i + 1 < len(trajectory.times_s) else None
