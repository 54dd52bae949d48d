"""Refine the pose and exposure of each frame against the map, and those of earlier keyframes as the map improves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.calibration.alignment import fit_pose
from gausslite.calibration.exposure import fit_exposure
from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, require_rigid, transform_of
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.mapping.keyframes import Keyframe, WindowView
from gausslite.mapping.pose_history import PoseHistory
from gausslite.render.rasterizer import Rendering

RenderMap = Callable[[Camera, Float64[ndarray, "4 4"], CameraMotion | None], Rendering]
"""Renders the map from T_world_camera, with the camera's motion."""


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """How views are refined.

    prior: standard deviations of pose and exposure errors. keyframes_per_frame: keyframes refined with each frame.
    anchor_share: share of the mission's mean correction by which each fit moves back; 0 if the poses do not come from
    an odometry.
    """

    prior: PoseExposurePrior
    keyframes_per_frame: int
    anchor_share: float


class ViewRefiner:
    """Refines views under the prior. It owns the pose history, the last pose correction and its place in the window.

    Each frame is aligned to the map, and the map is trained on the aligned frames, so both could drift from the
    odometry together. After each fit, the refined pose moves back by a share of the mission's mean correction.
    """

    def __init__(self, settings: RefinementSettings, render: RenderMap) -> None:
        self._prior = settings.prior
        self._settings = settings
        self._render = render
        self._history = PoseHistory()
        self._T_odometry_refined = np.eye(4)
        self._position = 0

    @property
    def enabled(self) -> bool:
        """False if poses and colours are used as recorded."""
        return not self._prior.is_exact

    @property
    def history(self) -> PoseHistory:
        """The poses of all mapped frames."""
        return self._history

    def state(self) -> State:
        """Return the pose history, the last pose correction and the position of the last refined keyframe."""
        return {
            "T_odometry_refined": self._T_odometry_refined,
            "position": int_array(self._position),
            **add_prefix("history", self._history.state()),
        }

    def restore(self, state: State) -> None:
        """Continue from another refiner's state. Raises MapFileError, PoseError."""
        T_odometry_refined = get_array(state, "T_odometry_refined", (4, 4), np.float64)
        require_rigid("state T_odometry_refined", T_odometry_refined)
        self._T_odometry_refined = T_odometry_refined.copy()
        [self._position] = get_counts(state, "position", 1)
        self._history.restore(select_prefix(state, "history"))

    def refine(self, recorded: Frame) -> Frame:
        """Return a new frame with refined pose and exposure. The search starts at the last frame's pose correction."""
        initial = recorded.T_world_camera
        if self._prior.has_pose_error:
            initial = initial @ self._T_odometry_refined
        frame = self._fit(recorded, initial)
        self._T_odometry_refined = inverse(recorded.T_world_camera) @ frame.T_world_camera
        return frame

    def next_views(self, window: Sequence[WindowView]) -> list[WindowView]:
        """Return the keyframes to refine with this frame, in rotation over the window."""
        refinable = [view for view in window if view.keyframe.recorded is not None]
        count = min(self._settings.keyframes_per_frame, len(refinable))
        first = self._position + 1
        self._position = (self._position + count) % max(len(refinable), 1)
        return [refinable[position % len(refinable)] for position in range(first, first + count)]

    def refine_keyframe(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe with its pose and exposure refined against the current map."""
        if keyframe.recorded is None:
            return keyframe
        return replace(keyframe, frame=self._fit(keyframe.recorded, keyframe.frame.T_world_camera))

    def _fit(self, recorded: Frame, T_world_rendered: Float64[ndarray, "4 4"]) -> Frame:
        rendering = self._render(recorded.camera, T_world_rendered, recorded.motion)
        T_world_camera = fit_pose(rendering, inverse(T_world_rendered), recorded, self._prior)
        if self._prior.has_pose_error:
            T_world_camera = self._anchored(recorded, T_world_camera)
        exposure = fit_exposure(rendering, recorded, self._prior)
        return replace(recorded, rgb=exposure.to_map(recorded.rgb), T_world_camera=T_world_camera)

    def _anchored(self, recorded: Frame, T_world_camera: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
        """Return the pose moved back by a share of the mean correction, and store it in the history."""
        self._history.record(recorded, T_world_camera)
        back = -self._settings.anchor_share * self._history.mean_correction
        anchored = T_world_camera.copy()
        anchored[:3, :3] = transform_of(back)[:3, :3] @ T_world_camera[:3, :3]
        anchored[:3, 3] += back[:3]
        self._history.record(recorded, anchored)
        return anchored
