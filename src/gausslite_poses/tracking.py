"""Track the camera against the map: predict its pose, align it, detect a loss, and recover from matched features."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import (
    inverse,
    orthonormal,
    require_rigid,
    rotation_angle_deg,
    transform_of,
    translation_m,
    twist_of,
)
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.mapping.pose_estimation import RenderMap
from gausslite_poses.features import FeatureView, detect_features, relative_pose
from gausslite_poses.photometric import COARSE_TO_FINE, FINE, Alignment, PyramidLevel, align

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
    anchor: int


class KeyframeIndex:
    """Keyframes spread over the places that the camera has seen; at most 200, the oldest of which are replaced."""

    def __init__(self) -> None:
        self._keyframes: list[_IndexedKeyframe] = []
        self._next_tried = 0

    def __len__(self) -> int:
        return len(self._keyframes)

    def add(self, features: FeatureView, T_world_camera: Float64[ndarray, "4 4"], anchor: int) -> None:
        """Store a tracked frame if no keyframe is near it; anchor: see `Keyframe`."""
        for keyframe in self._keyframes:
            near = translation_m(keyframe.T_world_camera, T_world_camera) < _MIN_DISTANCE_M
            if near and rotation_angle_deg(keyframe.T_world_camera, T_world_camera) < _MIN_ANGLE_DEG:
                return
        self._keyframes = [*self._keyframes, _IndexedKeyframe(features, T_world_camera, anchor)][-_MAX_KEYFRAMES:]

    def candidates(self, features: FeatureView, camera: Camera) -> Iterator[Float64[ndarray, "4 4"]]:
        """Yield possible T_world_camera of a frame, from a few keyframes; further calls continue with the next ones."""
        for _ in range(min(_TRIED_PER_FRAME, len(self._keyframes))):
            # newest first: after a short loss the camera is near the last keyframes
            keyframe = self._keyframes[-1 - self._next_tried % len(self._keyframes)]
            self._next_tried += 1
            pose = relative_pose(keyframe.features, features, camera)
            if pose is not None and pose.inliers >= _MIN_INLIERS:
                yield keyframe.T_world_camera @ inverse(pose.T_current_reference)

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move all keyframes with their anchors."""
        self._keyframes = [
            replace(keyframe, T_world_camera=T_corrected_earlier[keyframe.anchor] @ keyframe.T_world_camera)
            for keyframe in self._keyframes
        ]

    def restart(self) -> None:
        """Let the next call of `candidates` begin with the newest keyframe."""
        self._next_tried = 0

    def state(self) -> State:
        """Return all keyframes as named arrays."""
        poses = np.array([keyframe.T_world_camera for keyframe in self._keyframes]).reshape(-1, 4, 4)
        anchors = int_array(*(keyframe.anchor for keyframe in self._keyframes))
        state = {"T_world_camera": poses, "anchors": anchors, "next_tried": int_array(self._next_tried)}
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
        anchors = get_counts(state, "anchors", len(poses))
        self._keyframes = [
            _IndexedKeyframe(FeatureView.from_state(select_prefix(state, str(i))), T.copy(), anchor)
            for i, (T, anchor) in enumerate(zip(poses, anchors, strict=True))
        ]
        [self._next_tried] = get_counts(state, "next_tried", 1)


_MIN_OVERLAP = 0.5
_MAX_RESIDUAL = 0.15
"""An alignment with less overlap, or a larger luminance residual, counts as a loss. Tracked frames of the kitchen of
7-Scenes and of simulated homes have at least 0.7 and at most 0.06."""
_MIN_FEATURE_INLIERS = 20
"""Feature matches with the last frame predict the pose if they are this many; otherwise the motion model does."""
_RELIABLE_FEATURE_INLIERS = 40
"""With this many, the pose counts as tracked where the map covers too little of the view for an alignment."""
_RENDER_AGAIN_M, _RENDER_AGAIN_RAD = 0.01, np.radians(0.5)
_PRIOR_STD = np.array([0.1] * 3 + [np.radians(5.0)] * 3)
"""Error of a predicted pose: translation (m) and rotation (rad)."""


class TrackingMethod(StrEnum):
    """How a frame's pose was found."""

    START = "start"
    """The first frame keeps its pose."""
    MAP = "map"
    FEATURES = "features"
    """Feature matches with the last frame alone: the map covers too little of the view."""
    RELOCALISATION = "relocalisation"


@dataclass(frozen=True, slots=True, eq=False)
class _LastFrame:
    time_ns: int
    T_world_camera: Float64[ndarray, "4 4"]
    features: FeatureView


class CameraTracker:
    """Tracks one camera. Call `track` with each frame, map it, then call `confirm` with the pose it was mapped with.

    The first frame's own pose is the start, so the map lies in its world frame; poses of later frames are not used. Not
    thread-safe.
    """

    def __init__(self, render: RenderMap) -> None:
        """Render: renders the map from T_world_camera, for the camera's motion while a frame was exposed."""
        self._render = render
        self._keyframes = KeyframeIndex()
        self._last: _LastFrame | None = None
        self._velocity = np.zeros(6)
        self._lost_frames = 0
        self._counts: Counter[str] = Counter()
        self._pending: _LastFrame | None = None

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of frames by `TrackingMethod`, and of lost frames ("lost")."""
        return {name: self._counts[name] for name in (*TrackingMethod, "lost")}

    def track(self, frame: Frame) -> Float64[ndarray, "4 4"] | None:
        """Return the frame's T_world_camera; None if the camera is lost."""
        features = detect_features(frame)
        found = self._find(frame, features)
        if found is None:
            self._lost_frames += 1
            self._counts["lost"] += 1
            self._pending = None
            return None
        T_world_camera, tracked_by = found
        if self._lost_frames > 0:
            self._velocity = np.zeros(6)
            self._lost_frames = 0
            self._keyframes.restart()
        self._counts[tracked_by] += 1
        T_world_camera = orthonormal(T_world_camera)
        self._pending = _LastFrame(frame.capture_time_ns, T_world_camera, features)
        return T_world_camera

    def confirm(self, T_world_camera: Float64[ndarray, "4 4"], anchor: int = 0) -> None:
        """Set the pose that the last tracked frame was mapped with, and the keyframe that it follows."""
        pending, last = self._pending, self._last
        if pending is None:
            return
        current = _LastFrame(pending.time_ns, orthonormal(T_world_camera), pending.features)
        if last is not None and current.time_ns > last.time_ns:
            step = twist_of(inverse(last.T_world_camera) @ current.T_world_camera)
            self._velocity = step / (1e-9 * (current.time_ns - last.time_ns))
        self._keyframes.add(current.features, current.T_world_camera, anchor)
        self._last, self._pending = current, None

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move the confirmed poses with their keyframes; the last frame follows the newest one."""
        self._keyframes.move(T_corrected_earlier)
        if self._last is not None:
            T_world_camera = orthonormal(T_corrected_earlier[-1] @ self._last.T_world_camera)
            self._last = replace(self._last, T_world_camera=T_world_camera)

    def _find(self, frame: Frame, features: FeatureView) -> tuple[Float64[ndarray, "4 4"], TrackingMethod] | None:
        last = self._last
        if last is None:
            return frame.T_world_camera, TrackingMethod.START
        if self._lost_frames > 0:
            return self._relocalise(frame, features)
        by_features = relative_pose(last.features, features, frame.camera)
        predictions: list[tuple[Float64[ndarray, "4 4"], tuple[PyramidLevel, ...]]]
        predictions = [(self._predict(frame, last), COARSE_TO_FINE)]
        if by_features is not None and by_features.inliers >= _MIN_FEATURE_INLIERS:
            predictions.insert(0, (last.T_world_camera @ inverse(by_features.T_current_reference), FINE))
        for T_world_predicted, levels in predictions:
            alignment = self._align(frame, T_world_predicted, levels)
            if alignment is not None:
                return alignment.T_world_camera, TrackingMethod.MAP
        if by_features is not None and by_features.inliers >= _RELIABLE_FEATURE_INLIERS:
            return predictions[0][0], TrackingMethod.FEATURES
        return self._relocalise(frame, features)

    def _predict(self, frame: Frame, last: _LastFrame) -> Float64[ndarray, "4 4"]:
        T_last_frame = transform_of(self._velocity * 1e-9 * (frame.capture_time_ns - last.time_ns))
        T_world_camera: Float64[ndarray, "4 4"] = last.T_world_camera @ T_last_frame
        return T_world_camera

    def _relocalise(self, frame: Frame, features: FeatureView) -> tuple[Float64[ndarray, "4 4"], TrackingMethod] | None:
        for T_world_camera in self._keyframes.candidates(features, frame.camera):
            alignment = self._align(frame, T_world_camera, COARSE_TO_FINE)
            if alignment is not None:
                return alignment.T_world_camera, TrackingMethod.RELOCALISATION
        return None

    def _align(
        self, frame: Frame, T_world_predicted: Float64[ndarray, "4 4"], levels: tuple[PyramidLevel, ...]
    ) -> Alignment | None:
        """Return the pose aligned to the map near a prediction; None if map and frame do not agree there."""
        rendering = self._render(frame.camera, T_world_predicted, frame.motion)
        alignment = align(rendering, T_world_predicted, frame, _PRIOR_STD, levels)
        if alignment is None:
            return None
        step = np.abs(twist_of(inverse(T_world_predicted) @ alignment.T_world_camera))
        if step[:3].max() > _RENDER_AGAIN_M or step[3:].max() > _RENDER_AGAIN_RAD:
            rendering = self._render(frame.camera, alignment.T_world_camera, frame.motion)
            alignment = align(rendering, alignment.T_world_camera, frame, _PRIOR_STD, FINE)
        if alignment is None or alignment.overlap < _MIN_OVERLAP or alignment.residual > _MAX_RESIDUAL:
            return None
        return alignment

    def state(self) -> State:
        """Return everything that the next frame depends on."""
        last = self._last
        stored: State = {}
        if last is not None:
            stored = {
                "time_ns": int_array(last.time_ns),
                "T_world_camera": last.T_world_camera,
                **add_prefix("features", last.features.state()),
            }
        return {
            **add_prefix("last", stored),
            **add_prefix("keyframes", self._keyframes.state()),
            "velocity": self._velocity,
            "counts": int_array(self._lost_frames, *self.counts.values()),
        }

    def restore(self, state: State) -> None:
        """Continue from another tracker's state. Raises MapFileError, PoseError."""
        self._keyframes.restore(select_prefix(state, "keyframes"))
        self._velocity = get_array(state, "velocity", (6,), np.float64).copy()
        if not np.isfinite(self._velocity).all():
            raise MapFileError("state velocity: expected finite numbers, got NaN or infinity")
        names = (*TrackingMethod, "lost")
        self._lost_frames, *counts = get_counts(state, "counts", 1 + len(names))
        self._counts = Counter(dict(zip(map(str, names), counts, strict=True)))
        last = select_prefix(state, "last")
        if not last:
            return
        T_world_camera = get_array(last, "T_world_camera", (4, 4), np.float64)
        require_rigid("state tracked pose", T_world_camera)
        [time_ns] = get_array(last, "time_ns", (1,), np.int64)
        features = FeatureView.from_state(select_prefix(last, "features"))
        self._last = _LastFrame(int(time_ns), T_world_camera.copy(), features)
