"""What refines the poses of views, or finds them, against the map: plug-ins of `gausslite.poses`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State
from gausslite.mapping.keyframes import Keyframe, WindowView
from gausslite.mapping.poses import PoseTable
from gausslite.plugins import Group, load
from gausslite.render.rasterizer import Rendering

RenderMap = Callable[[Camera, Float64[ndarray, "4 4"], CameraMotion | None], Rendering]
"""Renders the map from T_world_camera, with the camera's motion."""


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """How views are refined."""

    prior: PoseExposurePrior  # standard deviations of pose and exposure errors
    keyframes_per_frame: int  # keyframes refined with each frame
    anchor_share: float  # of the mission's mean correction, by which each fit moves back; 0 without an odometry


class ViewRefiner(Protocol):
    """Refines poses and exposures of views against the map, and stores each refined pose in the table."""

    def refine(self, recorded: Frame) -> Frame:
        """Return a new frame with refined pose and exposure."""

    def next_keyframes(self, window: Sequence[WindowView]) -> Iterator[Keyframe]:
        """Yield the keyframes to refine with this frame, each counted as refined when the next one is asked for."""

    def refine_keyframe(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe with its pose and exposure refined against the current map."""

    def state(self) -> State:
        """Return everything that the next frame depends on, except the table."""

    def restore(self, state: State) -> None:
        """Continue from another refiner's state. Raises MapFileError, PoseError."""


class CameraTracker(Protocol):
    """Tracks one camera. Call `track` with each frame, map it, then call `confirm` with the pose it was mapped with."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of frames by how their pose was found, and of lost frames ("lost")."""

    def track(self, frame: Frame) -> Float64[ndarray, "4 4"] | None:
        """Return the frame's T_world_camera; None if the camera is lost. The first frame's own pose is the start."""

    def confirm(self, T_world_camera: Float64[ndarray, "4 4"], anchor: int = 0) -> None:
        """Set the pose that the last tracked frame was mapped with, and the keyframe that it follows."""

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move the confirmed poses with their keyframes."""

    def state(self) -> State:
        """Return everything that the next frame depends on."""

    def restore(self, state: State) -> None:
        """Continue from another tracker's state. Raises MapFileError, PoseError."""


def open_refiner(settings: RefinementSettings, render: RenderMap, poses: PoseTable) -> ViewRefiner | None:
    """Return the refiner of a map; None where poses and colours are exact. Raises MissingPluginError."""
    if settings.prior.is_exact:
        return None
    create: Callable[[RefinementSettings, RenderMap, PoseTable], ViewRefiner]
    create = load(Group.POSES, "refine", purpose="pose-prior")
    return create(settings, render, poses)


def open_tracker(render: RenderMap) -> CameraTracker:
    """Return the tracker against a map. Raises MissingPluginError."""
    create: Callable[[RenderMap], CameraTracker] = load(Group.POSES, "track", purpose="--poses track")
    return create(render)
