"""The objects of a task from given observations, without frames and a detector."""

from collections.abc import Sequence

import numpy as np

from gausslite.domain.objects import ObjectRole
from gausslite.domain.pose import unit_up_axis
from gausslite.domain.task import TaskGraph
from gausslite.perception.evidence import Evidence, LandmarkState
from gausslite.perception.object_map import Landmark, ObjectMap, Observation
from gausslite.perception.relations import NamedObjects
from gausslite.perception.selector import open_selector
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.perception.targets import TargetSelector


class ObservedObjects:
    """An object map with the evidence, the relations and the targets of a task. Up is -y."""

    def __init__(self, graph: TaskGraph) -> None:
        settings = RelevanceTrackerSettings()
        self._evidence = Evidence(settings.evidence)
        self._object_map = ObjectMap()
        selector = open_selector(graph, (), np.array(unit_up_axis(settings.up_axis)))
        self._targets = TargetSelector(graph, NamedObjects(self._object_map, self._evidence, selector))

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        return self._object_map.objects

    @property
    def notes(self) -> tuple[str, ...]:
        return self._targets.notes(np.eye(4))

    def roles(self) -> list[ObjectRole]:
        return [self._targets.role(landmark) for landmark in self._object_map.objects]

    def observe(self, observations: Sequence[Observation]) -> None:
        self._object_map.observe(observations)

    def state(self, observation: Observation) -> LandmarkState | None:
        landmark = self._object_map.match(observation)
        return None if landmark is None else self._evidence.state(landmark)

    def target_of(self, observation: Observation) -> str | None:
        return self._targets.target_of(observation)

    def selected(self) -> list[str]:
        return [name for _, name in self._targets.select(np.eye(4))]
