"""A robot's mission between two lives of its agent: the mapping run, and the task it was at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from gausslite.domain.state import State, encode_text, get_array, get_counts, get_text, int_array
from gausslite.domain.task import TaskGraph
from gausslite.errors import GaussLiteError, MapFileError
from gausslite.mission.checkpoint import ResumeConfig, SavedRun
from gausslite.v1 import task_pb2
from gausslite.wire.convert import graph_from_message, graph_to_message


@dataclass(frozen=True, slots=True)
class MissionCheckpoint:
    """Where a mission stood when it was saved.

    last_index is the number of its last frame, graph the task in force, asked the words of the command line, and
    map_revision what watchers had seen.
    """

    last_index: int
    graph: TaskGraph
    asked: str
    map_revision: int

    def state(self) -> State:
        """What is saved beside the run."""
        data = graph_to_message(self.graph).SerializeToString()
        return {
            "graph": np.frombuffer(data, np.uint8),
            "asked": encode_text(self.asked),
            "map_revision": int_array(self.map_revision),
        }


@dataclass(frozen=True, slots=True)
class SavedAgentMission:
    """A mission as it lies in a file. It is as large as the map and its keyframes: let go of it once it is taken up."""

    run: SavedRun
    life: MissionCheckpoint

    @classmethod
    def read(cls, path: Path, terms: ResumeConfig) -> SavedAgentMission:
        """Raises MapFileError for a file that is none, MismatchError for one that was begun on other terms."""
        run = SavedRun.read(path)
        run.require(terms)
        try:
            data = get_array(run.beside, "graph", (None,), np.uint8).tobytes()
            graph = graph_from_message(task_pb2.TaskGraph.FromString(data))
            [map_revision] = get_counts(run.beside, "map_revision", 1)
            asked = get_text(run.beside, "asked")
        except (GaussLiteError, DecodeError) as error:
            raise MapFileError(f"{path}: expected the state of an agent's mission: {error}") from error
        return cls(run, MissionCheckpoint(run.last_index, graph, asked, map_revision))
