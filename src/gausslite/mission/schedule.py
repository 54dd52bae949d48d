"""The tasks of a mission over its time: those that change at known frames, and what a person says meanwhile."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import match_warnings
from gausslite.domain.relevance import PointedObject, PointM
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper


@dataclass(frozen=True, slots=True)
class TaskSchedule:
    """The first task of a mission (None without a task in natural language), and later ones by their first frame."""

    first: TaskGraph | None
    switches: tuple[tuple[int, TaskGraph], ...] = ()  # (frame number, task), ascending

    @classmethod
    def parse(cls, first: TaskGraph | None, switches: Sequence[str], parser: TaskParser) -> TaskSchedule:
        """Return the schedule with switches such as "120:Find the mug". Raises InvalidInputError, TaskError."""
        later = [_split_switch(text) for text in switches]
        if later and first is None:
            raise InvalidInputError("task-at: expected a first task, with --task TEXT, got none")
        for frame, count in Counter(frame for frame, _ in later).items():
            if count > 1:
                raise InvalidInputError(f"task-at: expected one task for a frame, got {count} for {frame}")
        return cls(first, tuple((frame, parser.parse(task)) for frame, task in later))

    def graphs(self) -> tuple[TaskGraph, ...]:
        """Return all tasks."""
        first = () if self.first is None else (self.first,)
        return (*first, *(graph for _, graph in self.switches))

    def at(self, frame_index: int) -> TaskGraph | None:
        """Return the task of a frame."""
        past = [(first_frame, graph) for first_frame, graph in self.switches if first_frame <= frame_index]
        return max(past, key=lambda switch: switch[0])[1] if past else self.first

    def with_switch(self, first_frame: int, graph: TaskGraph) -> TaskSchedule:
        """Return the schedule with another task from this frame on, until the next switch."""
        others = (switch for switch in self.switches if switch[0] != first_frame)
        return replace(self, switches=(*others, (first_frame, graph)))


def _split_switch(text: str) -> tuple[int, str]:
    number, colon, task = text.partition(":")
    if not (colon and number.isascii() and number.isdigit() and len(number) < 10 and task.strip()):
        raise InvalidInputError(f"task-at: expected a frame and a task such as '120:Find the mug', got {text!r}")
    return int(number), task.strip()


class ScheduledTaskMapper:
    """Process frames with a TaskMapper, assign each scheduled task before its first frame, and take what a person says.

    graph: the task that the mapper has now, with what a person points at; None without a task in natural language.
    schedule: all tasks, those of a person included. last_index: of the last frame, -1 for none.
    """

    def __init__(
        self,
        mapper: TaskMapper,
        schedule: TaskSchedule,
        estimators: EstimatorFactory,
        graph: TaskGraph | None,
        last_index: int,
    ) -> None:
        self.mapper, self.graph, self.schedule = mapper, graph, schedule
        self._estimators = estimators
        self._scheduled = schedule.at(last_index)
        self.last_index = last_index

    def process(self, frame: Frame) -> FrameOutcome:
        """Process one frame for the task that is scheduled for it."""
        scheduled = self.schedule.at(frame.index)
        if scheduled is not None and self._scheduled is not None and not scheduled.is_equivalent_to(self._scheduled):
            self.mapper.assign(self._estimators.build(scheduled))
            self.graph = scheduled
        self._scheduled, self.last_index = scheduled, frame.index
        return self.mapper.process(frame)

    def assign(self, graph: TaskGraph) -> TaskGraph:
        """Switch to a person's task, until the next scheduled one; return it with a warning for each unknown noun.

        Call it between two frames. Raises InvalidInputError.
        """
        if self.graph is None:
            raise InvalidInputError("task: expected a run that began with one (--task TEXT), which another can follow")
        if not graph.is_equivalent_to(self.graph):
            self.mapper.assign(self._estimators.build(graph))
        self.graph = self._scheduled = graph
        self.schedule = self.schedule.with_switch(self.last_index + 1, graph)
        return graph.with_warnings(match_warnings(self._estimators.noun_matches(graph)))

    def point_at(self, pointed: Sequence[PointedObject], excluded_m: Sequence[PointM] = ()) -> TaskGraph:
        """Add the objects that a person points at to the task, leave out those at points, and return the task.

        Call it between two frames. Raises InvalidInputError, TaskError.
        """
        if self.graph is None:
            raise InvalidInputError("pointed object: expected a run with a task, to which it belongs, got none")
        # before any change: a person may point at nothing
        masks = self.mapper.pointed_masks(pointed)
        extended = self.graph.with_pointed(noun for noun, _, _ in masks)
        if not extended.is_equivalent_to(self.graph):
            self.mapper.extend(self._estimators.build(extended))
        self.graph = extended
        self.mapper.point_at(masks, excluded_m)
        return extended
