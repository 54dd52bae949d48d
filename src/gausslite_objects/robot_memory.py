"""MemoryService of one robot: edits and areas are in the state of its mission, and in the folder of its results.

A robot of a team also knows the areas that people name on the server: a thread reads them.

`memory_service` is a plug-in of the group `gausslite.agent_services`.
"""

from __future__ import annotations

import functools
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from gausslite.domain.errors import GaussLiteError, InvalidInputError, MismatchError
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
from gausslite_agent.settings import AgentSettings
from gausslite_objects.areas import Area, read_areas, settled, write_areas
from gausslite_objects.edits import Edit, EditedObjects, apply_edits, read_edits, write_edits
from gausslite_objects.light_objects import LightObjects
from gausslite_objects.memory_client import MemoryClient, area_from_message
from gausslite_objects.memory_service import service_of

_log = logging.getLogger(__name__)
_INTERVAL_S = 2.0


@contextmanager
def memory_service(
    settings: AgentSettings, worker: MappingWorker, estimators: EstimatorFactory, save: Callable[[], float]
) -> Iterator[Service]:
    """Yield the service of an agent. save: saves its mission, if to a file."""
    place = RobotPlace(worker, estimators, save)
    with nullcontext() if settings.link.fusion is None else _following(settings, settings.link.fusion, place):
        yield service_of(place.of_mission)


@contextmanager
def _following(settings: AgentSettings, server: str, place: RobotPlace) -> Iterator[None]:
    """Read the team's areas every two seconds, in a thread, until the context ends."""
    ending = threading.Event()

    def follow() -> None:
        last_error = ""
        while not ending.wait(_INTERVAL_S):
            try:
                memory = client.read(settings.link.mission_id, settings.agent_id)
                place.follow_team(tuple(map(area_from_message, memory.areas)))
                last_error = ""
            except GaussLiteError as error:
                if not ending.is_set() and str(error) != last_error:
                    _log.warning("areas of the team: %s; retrying", error)
                    last_error = str(error)

    with MemoryClient(server, settings.tls) as client:
        thread = threading.Thread(target=follow, name="team-areas", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            client.close()
            thread.join()


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
        self._change(lambda memory: memory.change(edits, memory.areas, memory.team_areas))

    def areas(self, agent_id: str = "") -> tuple[Area, ...]:
        """Return the areas named here and on the team's server. Raises MismatchError for another agent's frame."""
        if agent_id:
            raise MismatchError(f"agent: expected none, because an agent has one map, got {agent_id!r}")
        return self._memory.known_areas

    def save_areas(self, areas: tuple[Area, ...]) -> None:
        """Replace the areas. Raises StorageError, InvalidInputError for a removed one of the team."""
        team, known = self._memory.team_areas, self._memory.known_areas
        own = tuple(area for area in areas if area not in team)
        if len(areas) < len(known) and any(area in team for area in known if area not in areas):
            raise InvalidInputError("area: expected one that was named on this agent, got one of the team's server")
        self._change(lambda memory: memory.change(memory.edits, own, team))

    def follow_team(self, areas: tuple[Area, ...]) -> None:
        """Replace the areas of the team, once there is a task that may name one; the next saved state has them."""
        if self._worker.status().graph is None:
            return
        memory = self._memory
        if (now := settled(areas, memory.team_areas)) != memory.team_areas:
            self._worker.change_objects(lambda: memory.change(memory.edits, memory.areas, now)).result()

    def objects(self) -> EditedObjects:
        """Return the robot's objects after all edits."""
        return apply_edits(self._worker.status().found, self.edits())

    def add(self, _outcome: FrameOutcome, _poses: PoseTable, _parts: Callable[[], Iterable[Gaussians]]) -> None:
        """Take nothing of a frame."""

    def write(self, folder: Path, _keyframes: Sequence[Keyframe]) -> None:
        """Write edits and areas, if there are any, beside the objects that were found. Raises StorageError."""
        memory = self._estimators.memory
        if not isinstance(memory, LightObjects):
            return
        if memory.edits:
            write_edits(folder, memory.edits)
        if memory.known_areas:
            write_areas(folder, memory.known_areas)

    def _edited(self, found: Sequence[ObjectLandmark]) -> tuple[ObjectLandmark, ...]:
        memory, prior = self._estimators.memory, self._worker.prior
        if not isinstance(memory, LightObjects):
            return tuple(found)
        if not self._is_carried and prior is not None and prior.motion is not None:
            self._is_carried = True
            folder = Path(get_text(prior.state(), PRIOR_FOLDER))
            memory.change(memory.edits or read_edits(folder), memory.areas or read_areas(folder), memory.team_areas)
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
