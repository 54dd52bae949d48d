"""The protocol of every sequence of posed RGB-D frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory


@runtime_checkable
class Source(Protocol):
    """A sequence with random access. Positions run from 0 to len - 1; `indices` returns the sequence's own numbers."""

    @property
    def name(self) -> str:
        """Short name for reports."""
        ...

    @property
    def camera(self) -> Camera:
        """Camera at the sequence's own resolution (pixel centres at +0.5)."""
        ...

    @property
    def lens(self) -> Lens | None:
        """Distortion of the colour images that the sequence's files state; None if they state none."""
        ...

    @property
    def up_axis(self) -> UpAxis:
        """Unit vector of the world frame that points up."""
        ...

    @property
    def depth_registered(self) -> bool:
        """True if each depth pixel belongs to the colour pixel at the same place."""
        ...

    @property
    def camera_ideal(self) -> bool:
        """True if images have no lens distortion, rolling shutter and motion blur; no estimate is made then."""
        ...

    @property
    def poses_exact(self) -> bool:
        """True if the poses have no error; no estimate is made then, and poses are not refined."""
        ...

    @property
    def world_frame(self) -> str:
        """Name of the poses' frame, the same for sequences that share it."""
        ...

    @property
    def regions_file(self) -> Path | None:
        """File of the ground-truth regions; None if there are none, or if the sequence computes them."""
        ...

    @property
    def excluded_frames(self) -> str:
        """Message on the recorded frames that the sequence excludes, and why; empty if there are none."""
        ...

    def __len__(self) -> int: ...

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i, resized to (width, height): colour by area, depth by nearest pixel.

        Raises DatasetError or PoseError with the name of the file.
        """
        ...

    def indices(self) -> Sequence[int]:
        """Return the frame number of each position, ascending."""
        ...

    def trajectory(self) -> Trajectory:
        """Return the pose at every position, at the frames' capture times. Raises DatasetError, PoseError."""
        ...

    def regions(self) -> Mapping[str, Region]:
        """Return ground-truth regions by object name; empty if the sequence has none."""
        ...


def require_position(source_name: str, i: int, count: int) -> None:
    """Raise DatasetError unless i is one of the positions 0 .. count - 1."""
    if not 0 <= i < count:
        raise DatasetError(f"{source_name}: expected a position from 0 to {count - 1}, got {i}")


def excluded_frames_note(count: int, recorded: int, reason: str) -> str:
    """Return the message of `Source.excluded_frames`."""
    return f"{count} of {recorded} colour images are skipped: {reason}" if count else ""


def require_frames(folder: Path, count: int, expected: str) -> None:
    """Raise DatasetError if the sequence has no frames."""
    if count == 0:
        raise DatasetError(f"{folder}: expected {expected}, got none")
