"""The pose of every mapped frame, by the odometry and as refined against the map, with the correction between them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import MAX_COORDINATE_M, Frame, FrameId
from gausslite.domain.pose import CorrectionTrack, PoseCorrection, Trajectory, inverse, orthonormal, require_rigid
from gausslite.domain.state import State, get_array, get_counts, int_array

_MAX_POSES = 20_000
"""Beyond this number, every second pose of the older half is removed: 5 MB."""
_RECENT_POSES = 32
"""Frames whose changes of correction give its uncertainty."""
_LONGEST_STEP_NS = 3600 * 10**9
"""Between two frames of a path: after a longer one the clock was set."""
_POSES = ("T_world_odometry", "T_world_prior", "T_world_map")


class _Pose(NamedTuple):
    """The pose by the odometry; the odometry's pose as loops have corrected it; the refined pose; see Keyframe.anchor.

    Until a loop corrects it, T_world_prior is the odometry's pose (of a tracked camera: the tracked one).
    """

    T_world_odometry: Float64[ndarray, "4 4"]
    T_world_prior: Float64[ndarray, "4 4"]
    T_world_map: Float64[ndarray, "4 4"]
    anchor: int

    @property
    def correction(self) -> Float64[ndarray, "6"]:
        """Translation (m) of the camera and rotation vector (rad) by refinement, both in world axes."""
        R = self.T_world_map[:3, :3] @ self.T_world_prior[:3, :3].T
        return np.concatenate([self.T_world_map[:3, 3] - self.T_world_prior[:3, 3], cv2.Rodrigues(R)[0].ravel()])

    def moved(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> _Pose:
        """Return the pose moved with its anchor."""
        T = T_corrected_earlier[self.anchor]
        return self._replace(T_world_prior=T @ self.T_world_prior, T_world_map=T @ self.T_world_map)


class PoseTable:
    """The poses of each frame by its id, in the order of mapping.

    T_corrected_odometry: how the loops so far correct poses of the odometry; None without one.
    """

    def __init__(self) -> None:
        self.T_corrected_odometry: Float64[ndarray, "4 4"] | None = None
        self._poses: dict[FrameId, _Pose] = {}
        self._correction_sum = np.zeros(6)
        self._odometry: tuple[FrameId, Float64[ndarray, "4 4"]] | None = None
        self._new: tuple[FrameId, _Pose] | None = None

    def __len__(self) -> int:
        return len(self._poses)

    def add_odometry(self, frame: Frame) -> Frame:
        """Keep the odometry's pose of the frame that is mapped next; return the frame with it as loops correct it."""
        self._odometry = frame.id, frame.T_world_camera
        T = self.T_corrected_odometry
        return frame if T is None else replace(frame, T_world_camera=orthonormal(T @ frame.T_world_camera))

    def add(self, frame: Frame, anchor: int) -> None:
        """Add the frame that is mapped now with its pose before refinement, and the keyframe that it follows.

        It counts from its first refined pose on, and replaces an earlier frame with its id.
        """
        prior = frame.T_world_camera
        known, odometry = self._odometry or (frame.id, prior)
        self._new = frame.id, _Pose(odometry if known == frame.id else prior, prior, prior, anchor)
        if earlier := self._poses.pop(frame.id, None):
            self._correction_sum -= earlier.correction

    def refine(self, frame: FrameId, T_world_map: Float64[ndarray, "4 4"]) -> None:
        """Replace the refined pose of a frame."""
        earlier = self._poses.get(frame)
        if earlier is not None:
            pose = earlier._replace(T_world_map=T_world_map)
            self._correction_sum -= earlier.correction
        elif self._new is not None and self._new[0] == frame:
            pose = self._new[1]._replace(T_world_map=T_world_map)
        else:
            return  # an earlier frame that has been removed
        self._correction_sum += pose.correction
        self._poses[frame] = pose
        if len(self._poses) > _MAX_POSES:
            self._thin()

    @property
    def newest_anchor(self) -> int:
        """The highest number of a keyframe that a pose follows; -1 without poses."""
        return max((pose.anchor for pose in self._poses.values()), default=-1)

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move all poses in the map with their keyframes, given by keyframe number; later ones of the odometry too."""
        T_earlier = np.eye(4) if self.T_corrected_odometry is None else self.T_corrected_odometry
        self.T_corrected_odometry = orthonormal(T_corrected_earlier[-1] @ T_earlier)
        self._poses = {key: pose.moved(T_corrected_earlier) for key, pose in self._poses.items()}
        self._correction_sum = self._sum_corrections()

    @property
    def mean_correction(self) -> Float64[ndarray, "6"]:
        """Mean over the mission of the camera's translation (m) and rotation vector (rad), in world axes."""
        return self._correction_sum / max(len(self._poses), 1)

    def latest(self) -> PoseCorrection | None:
        """Return the correction of the newest frame; None before the first frame."""
        if not self._poses:
            return None
        (_, time_ns), newest = next(reversed(self._poses.items()))
        # loops correct all recent poses alike, so refinement alone makes successive corrections differ
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

    def path(self) -> tuple[Int64[ndarray, " n"], Float64[ndarray, "n 4 4"]]:
        """Return times and poses in the order of mapping; where the clock was set, the times go on as before."""
        times_ns = np.array([time_ns for _, time_ns in self._poses], np.int64)
        steps_ns = np.diff(times_ns, prepend=times_ns[:1])
        steps_ns[(steps_ns < 0) | (steps_ns > _LONGEST_STEP_NS)] = 0
        poses = np.array([pose.T_world_map for pose in self._poses.values()]).reshape(-1, 4, 4)
        return times_ns[:1] + steps_ns.cumsum(), poses

    def trajectory(self) -> Trajectory:
        """Return the latest estimate of every frame's pose in the map, by time."""
        times_ns, poses = self._by_time()
        return Trajectory(times_ns / 1e9, np.array([pose.T_world_map for pose in poses]).reshape(-1, 4, 4))

    def state(self) -> State:
        """Return all poses as named arrays."""
        return {
            "frames": np.array(list(self._poses), np.int64).reshape(-1, 2),
            **{
                name: np.array([getattr(pose, name) for pose in self._poses.values()]).reshape(-1, 4, 4)
                for name in _POSES
            },
            "anchor": int_array(*(pose.anchor for pose in self._poses.values())),
            "correction_sum": self._correction_sum,
        }

    def restore(self, state: State) -> None:
        """Continue from another table's state. Raises MapFileError, PoseError."""
        frames = get_array(state, "frames", (None, 2), np.int64)
        poses = [get_array(state, name, (len(frames), 4, 4), np.float64) for name in _POSES]
        anchors = get_counts(state, "anchor", len(frames))
        correction_sum = get_array(state, "correction_sum", (6,), np.float64)
        if len(frames) > _MAX_POSES:
            raise MapFileError(f"state poses: expected at most {_MAX_POSES}, got {len(frames)}")
        for T in itertools.chain(*poses):
            require_rigid("state poses", T)
            if np.abs(T[:3, 3]).max() > MAX_COORDINATE_M:
                raise MapFileError(f"state poses: expected positions within {MAX_COORDINATE_M:g} m of the origin")
        self._poses = {
            FrameId(int(index), int(time_ns)): _Pose(odometry.copy(), prior.copy(), in_map.copy(), anchor)
            for (index, time_ns), odometry, prior, in_map, anchor in zip(frames, *poses, anchors, strict=True)
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
