"""Refine the pose and colour of each frame against the map, and of the keyframes again as the map improves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.calibration.exposure import fit_exposure
from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.calibration.pose_fit import fit_pose
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, require_rigid
from gausslite.domain.state import State, get_array, get_counts, int_array
from gausslite.mapping.keyframes import Keyframe, WindowView
from gausslite.render.rasterizer import Rendering

Draw = Callable[[Camera, Float64[ndarray, "4 4"]], Rendering]
"""The map as a camera sees it from T_world_camera."""


class ViewRefiner:
    """Knows how far the last frame's pose was corrected, and whose turn it is among the keyframes."""

    def __init__(self, prior: PoseExposurePrior, draw: Draw, pose_updates_per_frame: int) -> None:
        self._prior = prior
        self._refits = pose_updates_per_frame
        self._draw = draw
        self._T_said_refined = np.eye(4)
        self._turn = 0

    @property
    def needed(self) -> bool:
        """False where poses and colours are trusted."""
        return not self._prior.is_exact

    def state(self) -> State:
        """How far the last pose was corrected, and whose turn it was."""
        return {"T_said_refined": self._T_said_refined, "turn": int_array(self._turn)}

    def restore(self, state: State) -> None:
        """Go on where another refiner stood. Raises MapFileError, PoseError."""
        T_said_refined = get_array(state, "T_said_refined", (4, 4), np.float64)
        require_rigid("state T_said_refined", T_said_refined)
        self._T_said_refined = T_said_refined.copy()
        [self._turn] = get_counts(state, "turn", 1)

    def settle(self, recorded: Frame) -> Frame:
        """A new frame with the pose and colours to map it with; an odometry's error is much like a frame ago."""
        start = recorded.T_world_camera @ self._T_said_refined if self._prior.has_pose_error else recorded.T_world_camera
        frame = self._fit(recorded, start)
        self._T_said_refined = inverse(recorded.T_world_camera) @ frame.T_world_camera
        return frame

    def next_turns(self, window: Sequence[WindowView]) -> list[WindowView]:
        """The keyframes to fit again with this frame, each in turn; none while there is none that may change."""
        refinable = [view for view in window if view.keyframe.recorded is not None]
        count = min(self._refits, len(refinable))
        first = self._turn + 1
        self._turn = (self._turn + count) % max(len(refinable), 1)
        return [refinable[turn % len(refinable)] for turn in range(first, first + count)]

    def fit_again(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe as it fits the map of now."""
        if keyframe.recorded is None:
            return keyframe
        return replace(keyframe, frame=self._fit(keyframe.recorded, keyframe.frame.T_world_camera))

    def _fit(self, recorded: Frame, T_world_drawn: Float64[ndarray, "4 4"]) -> Frame:
        drawn = self._draw(recorded.camera, T_world_drawn)
        T_world_camera = fit_pose(drawn, inverse(T_world_drawn), recorded, self._prior)
        colour = fit_exposure(drawn, recorded, self._prior)
        return replace(recorded, rgb=colour.to_map(recorded.rgb), T_world_camera=T_world_camera)
