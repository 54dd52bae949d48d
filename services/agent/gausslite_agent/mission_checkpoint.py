"""Save and read an agent's mission: the mapping run, its task and its map revision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from gausslite.domain.errors import GaussLiteError, MapFileError
from gausslite.domain.state import State, encode_text, get_array, get_counts, get_text, int_array
from gausslite.domain.task import TaskGraph
from gausslite.mission.checkpoint import SavedRun
from gausslite.v1 import task_pb2
from gausslite.wire.convert_task import graph_from_message, graph_to_message


@dataclass(frozen=True, slots=True)
class MissionCheckpoint:
    """A mission at the time it was saved.

    last_index: index of its last frame; graph: its task; requested_task: the task of the command line; map_revision:
    the latest revision that was sent to watchers.
    """

    last_index: int
    graph: TaskGraph
    requested_task: str
    map_revision: int

    def state(self) -> State:
        """Return the arrays that are saved with the mapping run."""
        data = graph_to_message(self.graph).SerializeToString()
        return {
            "graph": np.frombuffer(data, np.uint8),
            "requested_task": encode_text(self.requested_task),
            "map_revision": int_array(self.map_revision),
        }


@dataclass(frozen=True, slots=True)
class SavedMission:
    """A mission read from a file. It is as large as the map and its keyframes; release it after `restore`."""

    run: SavedRun
    checkpoint: MissionCheckpoint

    @classmethod
    def read(cls, path: Path, *settings: Any) -> SavedMission:
        """Read a saved mission.

        Raises MapFileError if the file is not one, MismatchError if it was saved with other settings.
        """
        run = SavedRun.read(path)
        run.require(*settings)
        try:
            data = get_array(run.extra, "graph", (None,), np.uint8).tobytes()
            graph = graph_from_message(task_pb2.TaskGraph.FromString(data))
            [map_revision] = get_counts(run.extra, "map_revision", 1)
            requested_task = get_text(run.extra, "requested_task")
        except (GaussLiteError, DecodeError) as error:
            raise MapFileError(f"{path}: expected the state of an agent's mission: {error}") from error
        return cls(run, MissionCheckpoint(run.last_index, graph, requested_task, map_revision))
