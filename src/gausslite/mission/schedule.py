"""What happens over a mission's time: tasks that change at known frames, the map's states, and a row for each frame."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.run_files import MapSnapshot, write_map_history
from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import match_warnings
from gausslite.domain.relevance import PointedObject, PointM
from gausslite.domain.state import EvenHistory
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.mapping.poses import PoseTable
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper

_MAX_SNAPSHOTS, _LEAST_GAP_NS = 48, 250_000_000


@dataclass(slots=True)
class MapRecorder:
    """Keeps at most 48 snapshots (25 ms and 230 kB each), four a second of the recording at most."""

    _snapshots: EvenHistory[MapSnapshot] = field(default_factory=lambda: EvenHistory(_MAX_SNAPSHOTS, _LEAST_GAP_NS))

    def record(self, poses: PoseTable, gaussians: Callable[[], Gaussians]) -> None:
        """Take a snapshot of the map after a frame, if one is due."""
        latest = poses.latest()
        if latest is None or not self._snapshots.is_due(latest.capture_time_ns):
            return
        # a map with a value that the codec refuses is still mapped further
        with suppress(InvalidInputError):
            snapshot = MapSnapshot.of(latest.capture_time_ns, gaussians())
            self._snapshots.add(snapshot.time_ns, snapshot)

    def write(self, folder: Path) -> None:
        """Write map_history.safetensors, with the snapshots since the start of this run. Raises StorageError."""
        write_map_history(folder, self._snapshots.states)


@dataclass(frozen=True, slots=True)
class TaskSchedule:
    """The first task of a mission (None without a task in natural language), and later ones by their first frame."""

    first: TaskGraph | None
    switches: tuple[tuple[int, TaskGraph], ...] = ()

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


_FILE = "frames.csv"
COLUMNS = ("frame", "seconds", "iterations", "gaussians", "roi_share", "localisation")
"""localisation: a value of `LocalisationState`."""
_MAX_ROWS = 100_000


@dataclass(slots=True)
class Timeline:
    """The rows of frames with their place or without it; every second one is removed whenever there are max_rows."""

    max_rows: int = _MAX_ROWS
    _rows: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, outcome: FrameOutcome) -> None:
        """Add one frame."""
        for shown in outcome.mapped or (outcome,) * (outcome.localisation > 0):
            figures = shown.index, shown.timing.seconds, shown.iterations, shown.gaussians, shown.roi_share
            self._rows.append((*figures, shown.localisation))
        if len(self._rows) >= self.max_rows:
            del self._rows[1::2]

    def write(self, folder: Path) -> None:
        """Write frames.csv. Raises StorageError."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in self._rows)
        write_atomic(folder / _FILE, text.getvalue().encode())


def read_timeline(folder: Path) -> dict[str, Float64[ndarray, " n"]]:
    """Return the columns of frames.csv by name; empty if the folder has none. Raises MapFileError."""
    path = folder / _FILE
    if not path.exists():
        return {}
    try:
        header, *rows = csv.reader(path.read_text().splitlines())
        values = np.array(rows, np.float64).reshape(len(rows), len(COLUMNS))
    except (OSError, ValueError, csv.Error) as error:
        raise MapFileError(f"{path}: expected the frames of a run, got an unreadable file: {error}") from error
    if tuple(header) != COLUMNS or not np.isfinite(values).all():
        raise MapFileError(f"{path}: expected finite columns {','.join(COLUMNS)}, got others")
    return dict(zip(COLUMNS, values.T, strict=True))
