"""The saved map that `gausslite map --prior` continues: localise the sequence in it, and say what changed."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.cli.map_inputs import MapInputs
from gausslite.datasets.moved_source import MovedSource
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import require_rigid
from gausslite.domain.state import State, encode_text, get_array, get_text
from gausslite.evaluation.views import view_map
from gausslite.mapping.free_space import DepthView
from gausslite.mission.map_diff import Change, Visit, compare_visits, with_earlier_objects
from gausslite.mission.prior import MAX_LOCALISED_FRAMES, SavedMap, SequenceLocaliser
from gausslite.mission.settings import PoseMode
from gausslite.mission.task_mapper import TaskMapper
from gausslite.process import print_message

_FOLDER, _MOTION, _FRAME = "prior_folder", "prior_T_map_sequence", "prior_world_frame"


@dataclass(frozen=True, slots=True, eq=False)
class PriorRun:
    """A saved map and the sequence's place in it. T_map_sequence: None if the sequence is not recognised there."""

    saved: SavedMap
    T_map_sequence: Float64[ndarray, "4 4"] | None
    frames_tried: int
    seconds: float

    @classmethod
    def localise(cls, folder: Path, inputs: MapInputs) -> PriorRun:
        """Localise the sequence in the map of a run, and print the result. Raises MapFileError."""
        saved, start_s = SavedMap.read(folder), time.monotonic()
        viewer = view_map(saved.gaussians, inputs.mission.backend, inputs.mission.threads)
        localiser = SequenceLocaliser(saved.places(viewer))
        motion = localiser.localise(_frames(inputs))
        seconds = time.monotonic() - start_s
        if motion is None:
            print_message(
                f"--prior {folder}: its map does not show the place of the {localiser.tried} frames that were tried; "
                "this run begins a map of its own"
            )
        else:
            print_message(f"--prior {folder}: localised after {localiser.tried} frames in {seconds:.1f} s")
        return cls(saved, motion, localiser.tried, seconds)

    def moved(self, inputs: MapInputs) -> MapInputs:
        """Return the inputs with the sequence in the saved map's frame, or as they are if it is not recognised."""
        if self.T_map_sequence is None:
            return inputs
        source = MovedSource(inputs.stream.source, self.T_map_sequence, self.saved.world_frame)
        return replace(inputs, stream=replace(inputs.stream, source=source))

    def gaussians_for(self, inputs: MapInputs) -> Gaussians | None:
        """Return the Gaussians to continue with; None if the sequence is not recognised."""
        task = inputs.schedule.first
        return None if self.T_map_sequence is None else self.saved.gaussians_for("" if task is None else task.text)

    def state(self) -> State:
        """Return what a resumed run needs."""
        if self.T_map_sequence is None:
            return {}
        return {
            _FOLDER: encode_text(str(self.saved.folder)),
            _MOTION: self.T_map_sequence,
            _FRAME: encode_text(self.saved.world_frame),
        }

    @classmethod
    def resumed(cls, extra: State) -> PriorRun | None:
        """Return the prior of a saved run; None without one. Raises MapFileError."""
        if _MOTION not in extra:
            return None
        T = get_array(extra, _MOTION, (4, 4), np.float64)
        require_rigid("state prior motion", T)
        return cls(SavedMap.read(Path(get_text(extra, _FOLDER))), T.copy(), 0, 0.0)

    def changes(self, mapper: TaskMapper, gaussians: Gaussians, inputs: MapInputs) -> list[Change]:
        """Return what the run's keyframes show to have changed since the saved map."""
        if self.T_map_sequence is None:
            return []
        viewer = view_map(self.saved.gaussians, inputs.mission.backend, inputs.mission.threads)
        views = [DepthView.of_frame(keyframe.frame) for keyframe in mapper.keyframes()]
        before = Visit(self.saved.gaussians, self.saved.objects, self.saved.depth_views(viewer))
        return compare_visits(before, Visit(gaussians, mapper.objects, views))

    def report(self, changes: Sequence[Change]) -> dict[str, object]:
        """Return the prior and what changed as parts of the report."""
        motion = self.T_map_sequence
        return {
            "prior": {
                "run": str(self.saved.folder),
                "localised": motion is not None,
                "T_map_sequence": None if motion is None else motion.tolist(),
                "frames_tried": self.frames_tried,
                "seconds": self.seconds,
            },
            "changes": [change.as_json() for change in changes],
        }

    def objects(self, found: Sequence[ObjectLandmark], changes: Sequence[Change]) -> list[ObjectLandmark]:
        """Return the run's objects, and the earlier ones that it has neither found again nor seen to be gone."""
        earlier = () if self.T_map_sequence is None else self.saved.objects
        return with_earlier_objects(found, earlier, changes)


def _frames(inputs: MapInputs) -> Iterator[Frame]:
    """Yield frames to localise: spread over the sequence; only its first ones if given poses are not used."""
    positions, count = inputs.stream.positions, MAX_LOCALISED_FRAMES
    step = 1 if inputs.mission.poses is PoseMode.TRACK else max(len(positions) // count, 1)
    for position in positions[::step][:count]:
        with suppress(DatasetError, PoseError):  # a frame that cannot be read is reported where it is mapped
            yield inputs.stream.source.frame(position, inputs.stream.size)
