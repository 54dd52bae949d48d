"""Switch the task of a mission at frames that are known before it starts."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.task import TaskGraph
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper


@dataclass(frozen=True, slots=True)
class TaskSwitch:
    """A new task, in natural language, from a frame index on."""

    frame: int
    text: str

    @classmethod
    def parse(cls, text: str) -> TaskSwitch:
        """Return the switch written as "120:Find the mug". Raises InvalidInputError."""
        number, colon, task = text.partition(":")
        if not (colon and number.isascii() and number.isdigit() and len(number) < 10 and task.strip()):
            raise InvalidInputError(f"task-at: expected a frame and a task such as '120:Find the mug', got {text!r}")
        return cls(int(number), task.strip())


@dataclass(frozen=True, slots=True)
class TaskSchedule:
    """The first task of a mission (None without a task in natural language), and later ones by their first frame."""

    first: TaskGraph | None
    switches: tuple[tuple[int, TaskGraph], ...] = ()

    def graphs(self) -> tuple[TaskGraph, ...]:
        """Return all tasks."""
        first = () if self.first is None else (self.first,)
        return (*first, *(graph for _, graph in self.switches))

    def at(self, frame_index: int) -> TaskGraph | None:
        """Return the task of a frame."""
        past = [(first_frame, graph) for first_frame, graph in self.switches if first_frame <= frame_index]
        return max(past, key=lambda switch: switch[0])[1] if past else self.first


class ScheduledTaskMapper:
    """Process frames with a TaskMapper, and assign each scheduled task before its first frame."""

    def __init__(
        self, mapper: TaskMapper, schedule: TaskSchedule, estimators: EstimatorFactory, current: TaskGraph | None
    ) -> None:
        """Current is the task that the mapper has now."""
        self._mapper = mapper
        self._schedule = schedule
        self._estimators = estimators
        self._current = current

    def process(self, frame: Frame) -> FrameOutcome:
        """Process one frame for the task that is scheduled for it."""
        graph = self._schedule.at(frame.index)
        if graph is not None and self._current is not None and not graph.is_equivalent_to(self._current):
            self._mapper.assign(self._estimators.build(graph))
        self._current = graph
        return self._mapper.process(frame)
