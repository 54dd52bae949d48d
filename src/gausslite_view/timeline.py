"""Keep a row for each frame of a run: its time, iterations, Gaussians and the region's share, in frames.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.task_mapper import FrameOutcome

_FILE = "frames.csv"
COLUMNS = ("frame", "seconds", "iterations", "gaussians", "roi_share", "localisation")
"""localisation: a value of `LocalisationState`."""
_MAX_ROWS = 100_000
_MAX_WAITED = 64


@dataclass(slots=True)
class Timeline:
    """The rows of frames with their place or without it; every second one is removed whenever there are max_rows."""

    max_rows: int = _MAX_ROWS
    _rows: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, outcome: FrameOutcome, _poses: PoseTable, _parts: Callable[[], Iterable[Gaussians]]) -> None:
        """Add one frame. Frames that waited have rows, with the state of the robot when they came."""
        for waited in outcome.recovered:
            newest = range(len(self._rows) - 1, max(len(self._rows) - _MAX_WAITED, 0) - 1, -1)
            row = next((i for i in newest if self._rows[i][0] == waited.index), None)
            if waited.skipped is None and row is not None:
                self._rows[row] = (*_figures(waited), self._rows[row][-1])
        if outcome.skipped is None or outcome.localisation > 0:
            self._rows.append((*_figures(outcome), outcome.localisation))
        if len(self._rows) >= self.max_rows:
            del self._rows[1::2]

    def write(self, folder: Path, _keyframes: Sequence[Keyframe]) -> None:
        """Write frames.csv. Raises StorageError."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in self._rows)
        write_atomic(folder / _FILE, text.getvalue().encode())


def _figures(outcome: FrameOutcome) -> tuple[float, ...]:
    return outcome.index, outcome.timing.seconds, outcome.iterations, outcome.gaussians, outcome.roi_share


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
