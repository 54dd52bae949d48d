"""Refine the poses and exposures of views against the map, within a prior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, require_rigid, transform_of
from gausslite.domain.state import State, get_array, get_counts, int_array
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.pose_estimation import RefinementSettings, RenderMap
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.window_view import WindowView
from gausslite_poses.exposure import fit_exposure
from gausslite_poses.photometric import fit_pose

_MAX_PIXELS = 4_000
"""Pixels that a fit compares: an evaluation gains from more, a map that still grows does not."""


class ViewRefiner:
    """Refines views under the prior. It owns the last pose correction and its place in the window.

    Each frame is aligned to the map, and the map is trained on the aligned frames, so both could drift from the
    odometry together. After each fit, the refined pose moves back by a share of the mission's mean correction.
    """

    def __init__(self, settings: RefinementSettings, render: RenderMap, poses: PoseTable) -> None:
        self._prior = settings.prior
        self._settings = settings
        self._render = render
        self._poses = poses
        self._T_odometry_refined = np.eye(4)
        self._position = 0

    def state(self) -> State:
        """Return the last pose correction and the position of the last refined keyframe."""
        return {"T_odometry_refined": self._T_odometry_refined, "position": int_array(self._position)}

    def restore(self, state: State) -> None:
        """Continue from another refiner's state. Raises MapFileError, PoseError."""
        T_odometry_refined = get_array(state, "T_odometry_refined", (4, 4), np.float64)
        require_rigid("state T_odometry_refined", T_odometry_refined)
        self._T_odometry_refined = T_odometry_refined.copy()
        [self._position] = get_counts(state, "position", 1)

    def refine(self, recorded: Frame) -> Frame:
        """Return a new frame with refined pose and exposure. The search starts at the last frame's pose correction."""
        initial = recorded.T_world_camera
        if self._prior.has_pose_error:
            initial = initial @ self._T_odometry_refined
        frame = self._fit(recorded, initial)
        self._T_odometry_refined = inverse(recorded.T_world_camera) @ frame.T_world_camera
        return frame

    def next_keyframes(self, window: Sequence[WindowView]) -> Iterator[Keyframe]:
        """Yield the keyframes to refine with this frame, in rotation over the window.

        The last one counts as refined when the next one is asked for.
        """
        refinable = [view.keyframe for view in window if view.keyframe.recorded is not None]
        for _ in range(min(self._settings.keyframes_per_frame, len(refinable))):
            position = (self._position + 1) % len(refinable)
            yield refinable[position]
            self._position = position

    def refine_keyframe(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe with its pose and exposure refined against the current map."""
        if keyframe.recorded is None:
            return keyframe
        return replace(keyframe, frame=self._fit(keyframe.recorded, keyframe.frame.T_world_camera))

    def _fit(self, recorded: Frame, T_world_rendered: Float64[ndarray, "4 4"]) -> Frame:
        rendering = self._render(recorded.camera, T_world_rendered, recorded.motion)
        T_world_camera = fit_pose(rendering, inverse(T_world_rendered), recorded, self._prior, _MAX_PIXELS)
        if self._prior.has_pose_error:
            T_world_camera = self._anchored(recorded, T_world_camera)
        exposure = fit_exposure(rendering, recorded, self._prior, _MAX_PIXELS)
        return replace(recorded, rgb=exposure.to_map(recorded.rgb), T_world_camera=T_world_camera)

    def _anchored(self, recorded: Frame, T_world_camera: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
        """Return the pose moved back by a share of the mean correction, and store it in the table."""
        self._poses.refine(recorded.id, T_world_camera)
        back = -self._settings.anchor_share * self._poses.mean_correction
        anchored = T_world_camera.copy()
        anchored[:3, :3] = transform_of(back)[:3, :3] @ T_world_camera[:3, :3]
        anchored[:3, 3] += back[:3]
        self._poses.refine(recorded.id, anchored)
        return anchored
