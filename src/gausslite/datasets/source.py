"""What every sequence of posed RGB-D frames offers, wherever its frames come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.errors import DatasetError


@runtime_checkable
class Source(Protocol):
    """A sequence with random access. Positions run from 0 to len - 1; `indices` gives the sequence's own numbers."""

    @property
    def name(self) -> str:
        """A short name for reports."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera at the sequence's own resolution (pixel centres at +0.5)."""
        ...

    @property
    def up_axis(self) -> UpAxis:
        """The unit vector of the world frame that points up."""
        ...

    @property
    def depth_registered(self) -> bool:
        """True when the recording brought its depth into the colour image's pixels."""
        ...

    @property
    def excluded_frames(self) -> str:
        """How much of the recording is no part of the sequence, and why; empty where all of it is."""
        ...

    def __len__(self) -> int: ...

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """The frame at position i, resized to (width, height): colour by area, depth by nearest.

        Raises DatasetError or PoseError with a line that names the file.
        """
        ...

    def indices(self) -> Sequence[int]:
        """The frame number of each position, ascending."""
        ...

    def regions(self) -> Mapping[str, Region]:
        """Ground-truth regions by object name; empty where the sequence has none."""
        ...


def require_position(source_name: str, i: int, count: int) -> None:
    """Raise DatasetError unless i is one of the positions 0 .. count - 1."""
    if not 0 <= i < count:
        raise DatasetError(f"{source_name}: expected a position from 0 to {count - 1}, got {i}")


def excluded_frames_note(count: int, recorded: int, why: str) -> str:
    """The line of `Source.excluded_frames`."""
    return f"{count} of {recorded} colour images are left out, {why}" if count else ""


def require_frames(folder: Path, count: int, wanted: str) -> None:
    """Raise DatasetError for a sequence without frames."""
    if count == 0:
        raise DatasetError(f"{folder}: expected {wanted}, got none")
