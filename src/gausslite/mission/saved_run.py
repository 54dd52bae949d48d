"""A mapping run between two processes: saved whole, and taken up again where it ended."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.state import State, nested, part, take, take_text, text, whole_numbers
from gausslite.domain.task import TaskGraph
from gausslite.errors import GaussLiteError, MapFileError, MismatchError
from gausslite.pipeline import TaskMapper


def save_run(path: Path, loop: TaskMapper, graph: TaskGraph | None, last_index: int) -> None:
    """Save a run whose last frame had this number. Raises StorageError."""
    about: State = {"task": text(_task(graph)), "last_index": whole_numbers(last_index)}
    write_state(path, {**nested("about", about), **nested("loop", loop.state())})


def resume_run(path: Path, loop: TaskMapper, graph: TaskGraph | None) -> int:
    """Put a fresh loop where the saved one stood; returns the number of its last frame.

    With the same settings the frames after that one give the same bits as without the interruption, as far as
    iterations are counted. Raises MapFileError for a file that is none, MismatchError for another task's.
    """
    saved = read_state(path)
    try:
        about = part(saved, "about")
        task = take_text(about, "task")
        [last_index] = take(about, "last_index", (1,), np.int64)
        if task != _task(graph):
            raise MismatchError(f"{path}: expected a run for {_task(graph)!r}, got one for {task[:200]!r}")
        loop.restore(part(saved, "loop"))
    except MismatchError:
        raise
    except GaussLiteError as error:
        raise MapFileError(f"{path}: {error}") from error
    return int(last_index)


def last_frame(path: Path) -> int:
    """The number of a saved run's last frame. Raises MapFileError."""
    try:
        [last_index] = take(part(read_state(path), "about"), "last_index", (1,), np.int64)
    except GaussLiteError as error:
        raise MapFileError(f"{path}: {error}") from error
    return int(last_index)


def _task(graph: TaskGraph | None) -> str:
    return "" if graph is None else graph.text
