"""What packages write beside the map of a run, such as its history or photographs: their protocol, and all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.plugins import Group, installed


class RunRecord(Protocol):
    """Writes a file beside the map of one run; a plug-in of `gausslite.run_records` is a class without arguments."""

    def add(self, outcome: FrameOutcome, poses: PoseTable, parts: Callable[[], Iterable[Gaussians]], /) -> None:
        """Take what the file needs of a processed frame. parts: yields the map."""

    def write(self, folder: Path, keyframes: Sequence[Keyframe], /) -> None:
        """Write the file after the last frame. keyframes: oldest first. Raises StorageError."""


def open_records() -> list[RunRecord]:
    """Return the installed records of one run."""
    return [create() for _, create in installed(Group.RUN_RECORDS)]
