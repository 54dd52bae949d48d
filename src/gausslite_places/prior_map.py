"""Continue a saved map: read a run's folder, and find the motion that takes a new sequence into its frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.codec.json import object_from_json
from gausslite.codec.ply import read_ply, read_world_frame
from gausslite.codec.run_files import KeyframeView, read_keyframe_views
from gausslite.domain.errors import CodecError, MapFileError, MismatchError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import inverse, orthonormal, rotation_angle_deg, translation_m
from gausslite.domain.relevance import NO_TARGET
from gausslite.mission.results import MAP, read_report
from gausslite.render.map_viewer import MapViewer, view_map
from gausslite_objects.changes import Change, compare_visits
from gausslite_objects.visit import Visit, depth_views, read_depths
from gausslite_places.localisation import PlaceMap, rendered_frame
from gausslite_places.surface_registration import Surface, register

MAX_LOCALISED_FRAMES = 12
_NEEDED = 2
"""Frames whose poses in the saved map must agree on one motion, more than those that contradict it: a single one could
show a repeated room."""
_AGREE_M, _AGREE_DEG = 0.3, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """The map of a finished run with its keyframes' poses, its objects and its task's text.

    depths_m: reduced depth images by the index of their keyframe.
    """

    folder: Path
    gaussians: Gaussians
    keyframes: Sequence[KeyframeView]
    depths_m: Mapping[int, Float32[ndarray, "h w"]]
    objects: tuple[ObjectLandmark, ...]
    task: str
    world_frame: str

    @classmethod
    def read(cls, folder: Path) -> SavedMap:
        """Read the folder of a run of `gausslite map` or of an agent. Raises MapFileError."""
        gaussians, keyframes = read_ply(folder / MAP), read_keyframe_views(folder)
        if not keyframes or len(gaussians) == 0:
            raise MapFileError(
                f"{folder}: expected a run with {MAP} and keyframes.json, got no keyframe or no Gaussian"
            )
        report = read_report(folder)
        if not report and (folder / "report.json").exists():
            raise MapFileError(f"{folder}: expected a run's report.json, got a damaged one")
        found = report.get("objects", [])
        if not isinstance(found, list):
            raise MapFileError(f"{folder}: expected a report.json with a list of objects, got another value")
        try:
            objects = tuple(map(object_from_json, found))
        except CodecError as error:
            raise MapFileError(f"{folder}: expected a report.json with the run's objects: {error}") from error
        task = report.get("task")
        return cls(
            folder=folder,
            gaussians=gaussians,
            keyframes=keyframes,
            depths_m=read_depths(folder, keyframes),
            objects=objects,
            task=str(task.get("text", "")) if isinstance(task, dict) else str(task or ""),
            world_frame=read_world_frame(folder / MAP),
        )

    def gaussians_for(self, task: str) -> Gaussians:
        """Return the Gaussians, with their kappa, for a run of this task; the region of another task is background."""
        if task == self.task:
            return self.gaussians
        n = len(self.gaussians)
        return replace(self.gaussians, active=np.zeros(n, np.bool_), target=np.full(n, NO_TARGET, np.int16))

    def moved(self, T: Float64[ndarray, "4 4"]) -> SavedMap:
        """Return the map after a rigid motion; each object's box is the axis-aligned one around its moved corners."""
        keyframes = [replace(view, T_world_camera=orthonormal(T @ view.T_world_camera)) for view in self.keyframes]
        objects = tuple(landmark.moved(T) for landmark in self.objects)
        return replace(self, gaussians=move_gaussians(self.gaussians, T), keyframes=keyframes, objects=objects)

    def visit(self) -> Visit:
        """Return what the run knows of its place."""
        return Visit(self.gaussians, self.objects, *depth_views(self.keyframes, self.depths_m))

    def places(self, viewer: MapViewer) -> PlaceMap:
        """Return the map's keyframes as rendered by a viewer of this map, to localise in."""
        places = PlaceMap(viewer.render)
        for keyframe in self.keyframes:
            places.add_rendered(keyframe.camera, keyframe.T_world_camera)
        return places


class SequenceLocaliser:
    """Finds one motion of a sequence into a map from some of its frames. Offer frames until `is_done`."""

    def __init__(self, places: PlaceMap) -> None:
        self._places = places
        self._motions: list[Float64[ndarray, "4 4"]] = []
        self.tried = 0
        self.T_map_sequence: Float64[ndarray, "4 4"] | None = None
        # the motion on which two frames more agree than contradict it

    @property
    def is_done(self) -> bool:
        """True if the motion is found, or no more frames are to be tried."""
        return self.T_map_sequence is not None or self.tried >= MAX_LOCALISED_FRAMES

    def offer(self, frame: Frame) -> bool:
        """Localise a frame, whose own pose is in the sequence's frame; False if it is not recognised."""
        self.tried += 1
        place = self._places.localise(frame)
        if place is None:
            return False
        motion = place.T_world_camera @ inverse(frame.T_world_camera)
        self._motions.append(motion)
        agreeing = sum(_agree(other, motion, frame) for other in self._motions)
        if agreeing - (len(self._motions) - agreeing) >= _NEEDED:
            self.T_map_sequence = motion
        return True

    def localise(self, frames: Iterable[Frame]) -> Float64[ndarray, "4 4"] | None:
        """Offer frames until a motion is found, and return it; None if it is not."""
        for frame in frames:
            if self.is_done:
                break
            self.offer(frame)
        return self.T_map_sequence


def _agree(a: Float64[ndarray, "4 4"], b: Float64[ndarray, "4 4"], frame: Frame) -> bool:
    """Return True if two motions place the frame's camera alike."""
    T_a, T_b = a @ frame.T_world_camera, b @ frame.T_world_camera
    return translation_m(T_a, T_b) < _AGREE_M and rotation_angle_deg(T_a, T_b) < _AGREE_DEG


def compare_runs(before: SavedMap, after: SavedMap) -> list[Change]:
    """Return what changed between two runs of one place, in the frame of the earlier one.

    Maps of one world frame are compared as they are. The later one is localised otherwise: MismatchError if it is not
    recognised.
    """
    if before.world_frame == after.world_frame and before.world_frame:
        return compare_visits(before.visit(), after.visit())
    after = after.moved(_motion_between(before, after))
    return compare_visits(before.visit(), after.moved(fitted_motion(before.visit(), after.visit())).visit())


def fitted_motion(before: Visit, after: Visit) -> Float64[ndarray, "4 4"]:
    """Return the small motion that fits the later surface to the earlier one; the identity if they overlap little."""
    source, target = (Surface.sampled(visit.surface_m) for visit in (after, before))
    registration = register(source, target, guess=np.eye(4))
    return np.eye(4) if registration is None else registration.T_target_source


def _motion_between(before: SavedMap, after: SavedMap) -> Float64[ndarray, "4 4"]:
    """Return the motion of the later map into the earlier one's frame. Raises MismatchError."""
    before_viewer, after_viewer = (view_map(saved.gaussians) for saved in (before, after))
    step = max(len(after.keyframes) // MAX_LOCALISED_FRAMES, 1)
    frames = (rendered_frame(after_viewer.render, view.camera, view.T_world_camera) for view in after.keyframes[::step])
    T = SequenceLocaliser(before.places(before_viewer)).localise(frames)
    if T is None:
        raise MismatchError(
            f"{after.folder}: expected a map of the place of {before.folder}, which none of its views shows"
        )
    return T
