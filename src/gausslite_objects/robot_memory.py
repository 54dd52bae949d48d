"""MemoryService of one robot: edits and areas are in the state of its mission, and in the folder of its results.

`memory_service` is a plug-in of the group `gausslite.agent_services`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from gausslite.domain.errors import MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.state import get_text
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.prior_map import PRIOR_FOLDER
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.wire.server import Service
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_objects.areas import Area, read_areas, write_areas
from gausslite_objects.edits import Edit, EditedObjects, apply_edits, read_edits, write_edits
from gausslite_objects.light_objects import LightObjects
from gausslite_objects.memory_service import service_of


def memory_service(worker: MappingWorker, estimators: EstimatorFactory, save: Callable[[], float]) -> Service:
    """Return the service of an agent. save: saves its mission, if to a file."""
    return service_of(RobotPlace(worker, estimators, save).of_mission)


class RobotPlace:
    """The ServedPlace of an agent, and the record of its run; each change is saved before it returns."""

    def __init__(self, worker: MappingWorker, estimators: EstimatorFactory, save: Callable[[], float]) -> None:
        self._worker, self._estimators, self._save = worker, estimators, save
        self._is_carried = False
        worker.edit_objects = self._edited
        worker.records.append(self)

    def of_mission(self, mission_id: str) -> RobotPlace:
        """Return this place. Raises MismatchError for the mission of a team."""
        if mission_id:
            raise MismatchError(f"mission: expected none, because an agent has its own, got {mission_id!r}")
        return self

    def edits(self) -> tuple[Edit, ...]:
        """Return all edits, oldest first."""
        return self._memory.edits

    def save_edits(self, edits: tuple[Edit, ...]) -> None:
        """Replace the edits. Raises StorageError."""
        self._change(lambda memory: memory.change(edits, memory.areas))

    def areas(self) -> tuple[Area, ...]:
        """Return the named areas."""
        return self._memory.areas

    def save_areas(self, areas: tuple[Area, ...]) -> None:
        """Replace the areas. Raises StorageError."""
        self._change(lambda memory: memory.change(memory.edits, areas))

    def objects(self) -> EditedObjects:
        """Return the robot's objects after all edits."""
        return apply_edits(self._worker.status().found, self.edits())

    def add(self, _outcome: FrameOutcome, _poses: PoseTable, _gaussians: Callable[[], Gaussians]) -> None:
        """Take nothing of a frame."""

    def write(self, folder: Path, _keyframes: Sequence[Keyframe]) -> None:
        """Write edits and areas, if there are any, beside the objects that were found. Raises StorageError."""
        memory = self._estimators.memory
        if not isinstance(memory, LightObjects):
            return
        if memory.edits:
            write_edits(folder, memory.edits)
        if memory.areas:
            write_areas(folder, memory.areas)

    def _edited(self, found: Sequence[ObjectLandmark]) -> tuple[ObjectLandmark, ...]:
        memory, prior = self._estimators.memory, self._worker.prior
        if not isinstance(memory, LightObjects):
            return tuple(found)
        if not self._is_carried and prior is not None and prior.motion is not None:
            self._is_carried = True
            folder = Path(get_text(prior.state(), PRIOR_FOLDER))
            memory.change(memory.edits or read_edits(folder), memory.areas or read_areas(folder))
        return apply_edits(found, memory.edits).objects

    def _change(self, change: Callable[[LightObjects], bool]) -> None:
        memory = self._memory
        self._worker.change_objects(lambda: change(memory)).result()
        self._save()

    @functools.cached_property
    def _memory(self) -> LightObjects:
        # only the worker's thread may make it
        memory = self._worker.run(lambda _: self._estimators.memory).result()
        if not isinstance(memory, LightObjects):
            raise MismatchError("objects: expected the object memory of gausslite_objects, got that of another package")
        return memory
