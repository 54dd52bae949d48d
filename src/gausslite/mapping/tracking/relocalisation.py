"""Find the camera again after a loss: match the frame's features with those of earlier keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import MapFileError
from gausslite.domain.pose import inverse, require_rigid, rotation_angle_deg, translation_m
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.mapping.tracking.features import FeatureView, relative_pose

_MIN_DISTANCE_M, _MIN_ANGLE_DEG = 0.25, 15.0
"""A keyframe is added if no other one is as near in both."""
_MAX_KEYFRAMES = 200
_TRIED_PER_FRAME = 12
"""Matching one keyframe takes about 3 ms."""
_MIN_INLIERS = 25


@dataclass(frozen=True, slots=True, eq=False)
class _IndexedKeyframe:
    features: FeatureView
    T_world_camera: Float64[ndarray, "4 4"]


class KeyframeIndex:
    """Keyframes spread over the places that the camera has seen; at most 200, the oldest of which are replaced."""

    def __init__(self) -> None:
        self._keyframes: list[_IndexedKeyframe] = []
        self._next_tried = 0

    def __len__(self) -> int:
        return len(self._keyframes)

    def add(self, features: FeatureView, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Store a tracked frame if no keyframe is near it."""
        for keyframe in self._keyframes:
            near = translation_m(keyframe.T_world_camera, T_world_camera) < _MIN_DISTANCE_M
            if near and rotation_angle_deg(keyframe.T_world_camera, T_world_camera) < _MIN_ANGLE_DEG:
                return
        self._keyframes = [*self._keyframes, _IndexedKeyframe(features, T_world_camera)][-_MAX_KEYFRAMES:]

    def candidates(self, features: FeatureView, camera: Camera) -> Iterator[Float64[ndarray, "4 4"]]:
        """Yield possible T_world_camera of a frame, from a few keyframes; further calls continue with the next ones."""
        for _ in range(min(_TRIED_PER_FRAME, len(self._keyframes))):
            # newest first: after a short loss the camera is near the last keyframes
            keyframe = self._keyframes[-1 - self._next_tried % len(self._keyframes)]
            self._next_tried += 1
            pose = relative_pose(keyframe.features, features, camera)
            if pose is not None and pose.inliers >= _MIN_INLIERS:
                yield keyframe.T_world_camera @ inverse(pose.T_current_reference)

    def restart(self) -> None:
        """Let the next call of `candidates` begin with the newest keyframe."""
        self._next_tried = 0

    def state(self) -> State:
        """Return all keyframes as named arrays."""
        poses = np.array([keyframe.T_world_camera for keyframe in self._keyframes]).reshape(-1, 4, 4)
        state = {"T_world_camera": poses, "next_tried": int_array(self._next_tried)}
        for i, keyframe in enumerate(self._keyframes):
            state |= add_prefix(str(i), keyframe.features.state())
        return state

    def restore(self, state: State) -> None:
        """Replace all keyframes by those of another index. Raises MapFileError, PoseError."""
        poses = get_array(state, "T_world_camera", (None, 4, 4), np.float64)
        if len(poses) > _MAX_KEYFRAMES:
            raise MapFileError(f"state tracking keyframes: expected at most {_MAX_KEYFRAMES}, got {len(poses)}")
        for T in poses:
            require_rigid("state tracking keyframes", T)
        self._keyframes = [
            _IndexedKeyframe(FeatureView.from_state(select_prefix(state, str(i))), T.copy())
            for i, T in enumerate(poses)
        ]
        [self._next_tried] = get_counts(state, "next_tried", 1)
