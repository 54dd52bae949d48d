"""Base of sources that change the frames of another source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory


class WrappedSource:
    """All of a Source except `frame`, as the wrapped source has it; subclasses override what they change."""

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def name(self) -> str:
        """Name of the wrapped source."""
        return self._source.name

    @property
    def camera(self) -> Camera:
        """Camera of the wrapped source."""
        return self._source.camera

    @property
    def lens(self) -> Lens | None:
        """Lens of the wrapped source."""
        return self._source.lens

    @property
    def up_axis(self) -> UpAxis:
        """Upward direction of the wrapped source."""
        return self._source.up_axis

    @property
    def depth_registered(self) -> bool:
        """True if the wrapped source's depth is registered."""
        return self._source.depth_registered

    @property
    def camera_ideal(self) -> bool:
        """True if the wrapped source's camera is ideal."""
        return self._source.camera_ideal

    @property
    def poses_exact(self) -> bool:
        """True if the wrapped source's poses are exact."""
        return self._source.poses_exact

    @property
    def world_frame(self) -> str:
        """World frame of the wrapped source."""
        return self._source.world_frame

    @property
    def regions_file(self) -> Path | None:
        """Region file of the wrapped source."""
        return self._source.regions_file

    @property
    def excluded_frames(self) -> str:
        """Message of the wrapped source."""
        return self._source.excluded_frames

    def __len__(self) -> int:
        return len(self._source)

    def indices(self) -> Sequence[int]:
        """Return the frame numbers of the wrapped source."""
        return self._source.indices()

    def trajectory(self) -> Trajectory:
        """Return the poses of the wrapped source."""
        return self._source.trajectory()

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of the wrapped source, which are in the world frame."""
        return self._source.regions()
