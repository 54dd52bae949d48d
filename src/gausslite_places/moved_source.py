"""A sequence in another world frame: all of its poses and regions moved by one rigid motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis, inverse, orthonormal, unit_up_axis
from gausslite.domain.relevance import Region


@dataclass(frozen=True, slots=True, eq=False)
class _MovedRegion:
    """A region of the source, for frames in the new world frame."""

    region: Region
    T_source_world: Float64[ndarray, "4 4"]

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the region."""
        return self.region.mask(replace(frame, T_world_camera=orthonormal(self.T_source_world @ frame.T_world_camera)))


class MovedSource(WrappedSource):
    """A source in another world frame, of this name. T_world_source: from its own world frame to it."""

    def __init__(self, source: Source, T_world_source: Float64[ndarray, "4 4"], world_frame: str) -> None:
        super().__init__(source)
        self._T_world_source = T_world_source
        self._world_frame = world_frame

    @property
    def world_frame(self) -> str:
        """The name of the new world frame."""
        return self._world_frame

    @property
    def up_axis(self) -> UpAxis:
        """The upward direction in the new world frame."""
        x, y, z = self._T_world_source[:3, :3] @ np.array(self._source.up_axis)
        return unit_up_axis((float(x), float(y), float(z)))

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i with its pose in the new world frame. Raises DatasetError, PoseError."""
        frame = self._source.frame(i, size)
        return replace(frame, T_world_camera=orthonormal(self._T_world_source @ frame.T_world_camera))

    def trajectory(self) -> Trajectory:
        """Return the poses in the new world frame."""
        trajectory = self._source.trajectory()
        return replace(trajectory, T_world_camera=self._T_world_source @ trajectory.T_world_camera)

    def regions(self) -> Mapping[str, Region]:
        """Return the regions in the new world frame."""
        T_source_world = inverse(self._T_world_source)
        return {name: _MovedRegion(region, T_source_world) for name, region in self._source.regions().items()}
