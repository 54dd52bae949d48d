"""The pose of every mapped frame, by the odometry and in the map, and the mean correction between them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import MAX_COORDINATE_M, Frame
from gausslite.domain.pose import inverse, require_rigid
from gausslite.domain.pose_correction import CorrectionTrack, PoseCorrection
from gausslite.domain.state import State, get_array
from gausslite.domain.trajectory import Trajectory

_MAX_POSES = 20_000
"""Beyond this number, every second pose of the older half is removed: 5 MB."""
_RECENT_POSES = 32
"""Frames whose changes of correction give its uncertainty."""


class _Pose(NamedTuple):
    T_world_odometry: Float64[ndarray, "4 4"]
    T_world_map: Float64[ndarray, "4 4"]

    @property
    def correction(self) -> Float64[ndarray, "6"]:
        """Translation (m) of the camera and rotation vector (rad), both in world axes."""
        R = self.T_world_map[:3, :3] @ self.T_world_odometry[:3, :3].T
        return np.concatenate([self.T_world_map[:3, 3] - self.T_world_odometry[:3, 3], cv2.Rodrigues(R)[0].ravel()])


class PoseHistory:
    """Poses by frame, in the order of their first mapping; a frame that is refined again replaces its pose."""

    def __init__(self) -> None:
        self._poses: dict[tuple[int, int], _Pose] = {}
        self._correction_sum = np.zeros(6)

    def __len__(self) -> int:
        return len(self._poses)

    def record(self, odometry: Frame, T_world_map: Float64[ndarray, "4 4"]) -> None:
        """Store the pose in the map of a frame, whose own pose is that of the odometry."""
        key = (odometry.index, odometry.capture_time_ns)
        earlier = self._poses.get(key)
        pose = _Pose(odometry.T_world_camera if earlier is None else earlier.T_world_odometry, T_world_map)
        if earlier is not None:
            self._correction_sum -= earlier.correction
        self._correction_sum += pose.correction
        self._poses[key] = pose
        if len(self._poses) > _MAX_POSES:
            self._thin()

    @property
    def mean_correction(self) -> Float64[ndarray, "6"]:
        """Mean over the mission of the camera's translation (m) and rotation vector (rad), in world axes."""
        return self._correction_sum / max(len(self._poses), 1)

    def latest(self) -> PoseCorrection | None:
        """Return the correction of the newest frame; None before the first frame."""
        if not self._poses:
            return None
        (_, time_ns), newest = next(reversed(self._poses.items()))
        recent = np.array([pose.correction for pose in list(self._poses.values())[-_RECENT_POSES:]])
        changes = np.diff(recent, axis=0) if len(recent) > 1 else np.zeros((1, 6))
        translation_m, rotation_rad = (
            float(np.sqrt(np.mean(np.square(changes[:, part])))) for part in (slice(3), slice(3, 6))
        )
        T_map_odometry = newest.T_world_map @ inverse(newest.T_world_odometry)
        return PoseCorrection(time_ns, T_map_odometry, translation_m, float(np.degrees(rotation_rad)))

    def corrections(self) -> CorrectionTrack | None:
        """Return the latest estimate of every frame's correction, by time; None before the first frame."""
        if not self._poses:
            return None
        times_ns, poses = self._by_time()
        return CorrectionTrack(
            times_ns, np.array([pose.T_world_map @ inverse(pose.T_world_odometry) for pose in poses])
        )

    def trajectory(self) -> Trajectory:
        """Return the latest estimate of every frame's pose in the map, by time."""
        times_ns, poses = self._by_time()
        return Trajectory(times_ns / 1e9, np.array([pose.T_world_map for pose in poses]).reshape(-1, 4, 4))

    def state(self) -> State:
        """Return all poses as named arrays."""
        return {
            "frames": np.array(list(self._poses), np.int64).reshape(-1, 2),
            "T_world_odometry": np.array([pose.T_world_odometry for pose in self._poses.values()]).reshape(-1, 4, 4),
            "T_world_map": np.array([pose.T_world_map for pose in self._poses.values()]).reshape(-1, 4, 4),
            "correction_sum": self._correction_sum,
        }

    def restore(self, state: State) -> None:
        """Continue from another history's state. Raises MapFileError, PoseError."""
        frames = get_array(state, "frames", (None, 2), np.int64)
        shape = (len(frames), 4, 4)
        T_world_odometry = get_array(state, "T_world_odometry", shape, np.float64)
        T_world_map = get_array(state, "T_world_map", shape, np.float64)
        correction_sum = get_array(state, "correction_sum", (6,), np.float64)
        if len(frames) > _MAX_POSES:
            raise MapFileError(f"state poses: expected at most {_MAX_POSES}, got {len(frames)}")
        for T in (*T_world_odometry, *T_world_map):
            require_rigid("state poses", T)
            if np.abs(T[:3, 3]).max() > MAX_COORDINATE_M:
                raise MapFileError(f"state poses: expected positions within {MAX_COORDINATE_M:g} m of the origin")
        self._poses = {
            (int(index), int(time_ns)): _Pose(odometry.copy(), in_map.copy())
            for (index, time_ns), odometry, in_map in zip(frames, T_world_odometry, T_world_map, strict=True)
        }
        # the stored sum has the rounding errors of its history, which a bit-identical continuation needs
        if not np.allclose(correction_sum, self._sum_corrections(), atol=1e-3):
            raise MapFileError("state correction_sum: expected the sum over the poses, got another")
        self._correction_sum = correction_sum.copy()

    def _by_time(self) -> tuple[ndarray, list[_Pose]]:
        by_time = sorted(self._poses.items(), key=lambda item: item[0][1])
        return np.array([time_ns for (_, time_ns), _ in by_time], np.int64), [pose for _, pose in by_time]

    def _thin(self) -> None:
        older = list(self._poses)[: len(self._poses) // 2]
        for key in older[1::2]:
            del self._poses[key]
        self._correction_sum = self._sum_corrections()

    def _sum_corrections(self) -> Float64[ndarray, "6"]:
        corrections = [pose.correction for pose in self._poses.values()]
        total: Float64[ndarray, "6"] = np.sum(corrections or [np.zeros(6)], axis=0)
        return total
