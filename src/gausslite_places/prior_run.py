"""A run that continues a saved map: localise its frames there, say what changed, and keep this for a resumed run."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.source import Source
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import require_rigid
from gausslite.domain.state import State, encode_text, get_array, get_counts, int_array
from gausslite.mapping.free_space import DepthView
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.prior_map import PRIOR_FOLDER, MapChanges, PriorMap
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import MissionSettings
from gausslite.render.map_viewer import view_map
from gausslite_objects.areas import CARRIED_AREAS, read_areas
from gausslite_objects.changes import Change, compare_visits, with_earlier_objects
from gausslite_objects.edits import CARRIED, edits_as_json, read_edits
from gausslite_objects.visit import Visit
from gausslite_places.moved_source import MovedSource, moved_frame
from gausslite_places.prior_map import MAX_LOCALISED_FRAMES, SavedMap, SequenceLocaliser


class PriorRun(PriorMap):
    """A saved map and the place of a sequence in it. Not thread-safe."""

    def __init__(self, folder: Path, settings: MissionSettings, saved: State) -> None:
        """Read the saved map and render its keyframes. Raises MapFileError, PoseError.

        settings: those of the new run. saved: its state if it is resumed.
        """
        self.saved = SavedMap.read(folder)
        start_s = time.monotonic()
        self._viewer = view_map(self.saved.gaussians, settings.backend, settings.threads)
        self._localiser = SequenceLocaliser(self.saved.places(self._viewer))
        self._seconds = time.monotonic() - start_s
        if PRIOR_FOLDER in saved:
            self._restore(saved)

    @property
    def motion(self) -> Float64[ndarray, "4 4"] | None:
        """T_map_sequence, which moves the sequence into the saved map's frame; None if it is not recognised there."""
        return self._localiser.T_map_sequence

    @property
    def world_frame(self) -> str:
        """The name of the saved map's frame; empty if the sequence is not recognised there."""
        return "" if self.motion is None else self.saved.world_frame

    @property
    def is_done(self) -> bool:
        """True if the sequence is localised, or enough frames were tried."""
        return self._localiser.is_done

    def localise(self, stream: FrameStream, spread: bool) -> None:
        """Localise frames of a recording: spread over it, or its first ones."""
        for frame in _frames(stream, spread):
            if self.is_done:
                return
            self._offer(frame)

    def place(self, frame: Frame) -> Frame | None:
        """Localise a live frame and return it in the map's frame, or as it is if that fails; None until it is done."""
        if not self.is_done:
            self._offer(frame)
        return moved_frame(frame, self.motion) if self.is_done else None

    def describe(self) -> str:
        """Return one line: whether the sequence is localised."""
        tried = f"{self._localiser.tried} frame{'' if self._localiser.tried == 1 else 's'}"
        if self.motion is not None:
            return f"prior {self.saved.folder}: localised after {tried} in {self._seconds:.1f} s"
        return (
            f"prior {self.saved.folder}: its map does not show the place of {tried} that were tried; "
            "this run begins a map of its own"
        )

    def gaussians_for(self, task: str) -> Gaussians | None:
        """Return the Gaussians that a run of this task continues with; None if the sequence is not recognised."""
        return None if self.motion is None else self.saved.gaussians_for(task)

    def moved(self, source: Source) -> Source:
        """Return a sequence of the run with poses and regions in the saved map's frame, once it is recognised."""
        return MovedSource(source, lambda: self.motion, self.saved.world_frame)

    def compare(
        self, gaussians: Gaussians, objects: Sequence[ObjectLandmark], keyframes: Sequence[Keyframe]
    ) -> MapChanges:
        """Return what the run's map, objects and keyframes show to have changed since the saved map."""
        changes: list[Change] = []
        if self.motion is not None:
            changes = compare_visits(self.saved.visit(), _visit(gaussians, objects, keyframes))
            objects = with_earlier_objects(objects, self.saved.objects, changes)
        folder = None if self.motion is None else self.saved.folder
        report = {
            "prior": self._report(),
            "changes": [change.as_json() for change in changes],
            CARRIED: edits_as_json(() if folder is None else read_edits(folder)),
            CARRIED_AREAS: [] if folder is None else [area.as_json() for area in read_areas(folder)],
        }
        return MapChanges(objects, tuple(map(Change.describe, changes)), report)

    def state(self) -> State:
        """Return what a resumed run needs."""
        motion = self.motion
        return {
            PRIOR_FOLDER: encode_text(str(self.saved.folder)),
            "prior_T_map_sequence": np.zeros((0, 4, 4)) if motion is None else motion[None],
            "prior_tried": int_array(self._localiser.tried),
        }

    def _restore(self, state: State) -> None:
        for T in get_array(state, "prior_T_map_sequence", (None, 4, 4), np.float64):
            require_rigid("state prior motion", T)
            self._localiser.T_map_sequence = T.copy()
        [self._localiser.tried] = get_counts(state, "prior_tried", 1)

    def _offer(self, frame: Frame) -> None:
        start_s = time.monotonic()
        self._localiser.offer(frame)
        self._seconds += time.monotonic() - start_s

    def _report(self) -> dict[str, object]:
        motion = self.motion
        return {
            "run": str(self.saved.folder),
            "localised": motion is not None,
            "T_map_sequence": None if motion is None else motion.tolist(),
            "frames_tried": self._localiser.tried,
            "seconds": self._seconds,
        }


def _visit(gaussians: Gaussians, objects: Sequence[ObjectLandmark], keyframes: Sequence[Keyframe]) -> Visit:
    frames = [keyframe.frame for keyframe in keyframes]
    return Visit(gaussians, objects, list(map(DepthView.reduced, frames)), [frame.capture_time_ns for frame in frames])


def _frames(stream: FrameStream, spread: bool) -> Iterator[Frame]:
    """Yield the frames to localise."""
    positions = stream.positions
    step = max(len(positions) // MAX_LOCALISED_FRAMES, 1) if spread else 1
    for position in positions[::step][:MAX_LOCALISED_FRAMES]:
        with suppress(DatasetError, PoseError):  # a frame that cannot be read is reported where it is mapped
            yield stream.source.frame(position, stream.size)
