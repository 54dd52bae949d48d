"""Estimate readout time and time offset of a camera from pairs of frames on moving stretches.

A frame is warped into a later one by depth and both poses, and the later frame's pose is fitted to the result. Wrong
times leave a photometric residual, and a rotation that the fit needs. The search minimises the residual over the
readout time. Then it minimises the rotation over the time offset, and over the readout time in finer steps. The result
is used only if it clearly reduces both.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy import ndarray

from gausslite.calibration.pose_exposure_error import warp_into
from gausslite.calibration.pose_fit import fit_pose, luminance_residual
from gausslite.calibration.view_residuals import comparable_pixels
from gausslite.datasets.camera_correction import correct_frame, ideal_camera
from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.selection import downscaled_size
from gausslite.datasets.source import Source
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, twist_of
from gausslite.domain.pose_exposure_prior import HANDHELD_PRIOR
from gausslite.domain.trajectory import Trajectory, Twist

_MAX_PAIRS, _MIN_PAIRS = 16, 4
_MIN_COMPARABLE_PIXELS = 1000
_MIN_SPEED_RAD_S = math.radians(8.0)
"""Slower cameras move rows by less than a pixel in a readout of 30 ms."""
_PAIR_TURN_RAD = math.radians(8.0)
_READOUTS_S = (0.0, 0.015, 0.03, 0.045)
_OFFSETS_S = (-0.02, 0.0, 0.02)
_FINE_STEP_S = 0.0075
_MIN_RESIDUAL_GAIN, _MIN_MOTION_GAIN = 0.005, 0.3


@dataclass(frozen=True, slots=True)
class PairError:
    """Disagreement of frame pairs: robust residual of the luminance (0 to 255), and rotation of the pose fit."""

    residual: float
    rotation_deg: float
    pairs: int


def estimate_camera_timing(source: Source, known: CameraCorrection) -> tuple[CameraCorrection, str]:
    """Return the correction with estimated readout and offset, and the evidence as one line.

    The lens of `known` is kept. Frames that cannot be read are skipped. Keeps the times of `known` if the camera moves
    too slowly, too few frames can be compared, or the gain is not clear.
    """
    trajectory = source.trajectory()
    pairs = moving_pairs(trajectory)
    if len(pairs) < _MIN_PAIRS:
        return known, f"{len(pairs)} pairs of frames turn fast enough, expected at least {_MIN_PAIRS}"
    frames = _read_frames(source, sorted({position for pair in pairs for position in pair}))

    def error(correction: CameraCorrection) -> PairError:
        return pair_error(frames, trajectory, pairs, correction)

    before = error(known)
    if before.pairs < _MIN_PAIRS:
        return known, f"{before.pairs} pairs of frames can be compared, expected at least {_MIN_PAIRS}"
    readout_s = _minimum(_READOUTS_S, lambda value: error(replace(known, readout_s=value)).residual)
    with_readout = replace(known, readout_s=round(readout_s, 3))
    offset_s = _minimum(_OFFSETS_S, lambda value: error(replace(with_readout, time_offset_s=value)).rotation_deg)
    found = replace(with_readout, time_offset_s=round(offset_s, 3))
    around_s = tuple(found.readout_s + step * _FINE_STEP_S for step in (-1, 0, 1))
    readout_s = _minimum(around_s, lambda value: error(replace(found, readout_s=value)).rotation_deg)
    found = replace(found, readout_s=round(readout_s, 3))
    after = error(found)
    evidence = (
        f"{after.pairs} pairs of moving frames: residual {before.residual:.2f} becomes {after.residual:.2f} of 255, "
        f"rotation error {before.rotation_deg:.2f} becomes {after.rotation_deg:.2f} deg"
    )
    is_clear = (
        after.residual <= (1.0 - _MIN_RESIDUAL_GAIN) * before.residual
        and after.rotation_deg <= (1.0 - _MIN_MOTION_GAIN) * before.rotation_deg
    )
    return (found, evidence) if is_clear else (known, f"{evidence}; no clear gain, not used")


def moving_pairs(trajectory: Trajectory) -> list[tuple[int, int]]:
    """Return positions of frame pairs on the fastest stretches; the second is turned by about 8 degrees."""
    speeds = trajectory.angular_speeds_rad_s()
    separation = max(1, len(speeds) // (2 * _MAX_PAIRS))
    pairs: list[tuple[int, int]] = []
    for i in np.argsort(-speeds).tolist():
        if len(pairs) == _MAX_PAIRS or speeds[i] < _MIN_SPEED_RAD_S:
            break
        if all(abs(i - first) >= separation for first, _ in pairs):
            second = _first_turned(trajectory, i)
            if second is not None:
                pairs.append((i, second))
    return pairs


def pair_error(
    frames: Mapping[int, Frame],
    trajectory: Trajectory,
    pairs: Sequence[tuple[int, int]],
    correction: CameraCorrection,
) -> PairError:
    """Return how far pairs of recorded frames disagree once corrected, each after a fit of pose and exposure."""
    corrected = {i: _corrected(frame, correction, trajectory.twist(i)) for i, frame in frames.items()}
    residuals, rotations_deg = [], []
    for i, j in pairs:
        first, second = corrected.get(i), corrected.get(j)
        if first is None or second is None:
            continue
        warped = warp_into(first, second)
        if len(comparable_pixels(warped, second)) < _MIN_COMPARABLE_PIXELS:
            continue
        T_world_fitted = fit_pose(warped, inverse(second.T_world_camera), second, HANDHELD_PRIOR)
        residuals.append(255.0 * luminance_residual(warped, second, T_world_fitted))
        change = twist_of(inverse(second.T_world_camera) @ T_world_fitted)
        rotations_deg.append(math.degrees(float(np.linalg.norm(change[3:]))))
    if not residuals:
        return PairError(math.inf, math.inf, 0)
    return PairError(float(np.mean(residuals)), float(np.median(rotations_deg)), len(residuals))


def _read_frames(source: Source, positions: Sequence[int]) -> dict[int, Frame]:
    """Return the frames that can be read."""
    frames = {}
    for position in positions:
        with contextlib.suppress(DatasetError, PoseError):
            frames[position] = source.frame(position)
    return frames


def _corrected(frame: Frame, correction: CameraCorrection, twist: Twist) -> Frame:
    """Return the corrected frame, downscaled; its field of view does not depend on the readout time."""
    ideal = ideal_camera(frame.camera, correction, 0.0)
    full = correct_frame(frame, correction, ideal, twist)
    image = resize_rgbd(RgbdImage(full.rgb, full.depth_m, full.camera), downscaled_size(ideal))
    return replace(full, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera)


def _first_turned(trajectory: Trajectory, i: int) -> int | None:
    R_world_first = trajectory.T_world_camera[i][:3, :3]
    for j in range(i + 1, len(trajectory.times_s)):
        turn = cv2.Rodrigues(R_world_first.T @ trajectory.T_world_camera[j][:3, :3])[0]
        if np.linalg.norm(turn) >= _PAIR_TURN_RAD:
            return j
    return len(trajectory.times_s) - 1 if i + 1 < len(trajectory.times_s) else None


def _minimum(values: Sequence[float], cost: Callable[[float], float]) -> float:
    """Return the minimum of a parabola through the best of evenly spaced values and its neighbours."""
    costs: ndarray = np.array([cost(value) for value in values])
    best = int(np.clip(np.argmin(costs), 1, len(values) - 2))
    a, b, c = costs[best - 1 : best + 2]
    curvature = a - 2 * b + c
    if not curvature > 0:
        return values[int(np.argmin(costs))]
    step = values[1] - values[0]
    return values[best] + step * float(np.clip(0.5 * (a - c) / curvature, -1.0, 1.0))
