"""A sequence in another world frame: all of its poses and regions moved by one rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis, inverse, orthonormal, unit_up_axis
from gausslite.domain.relevance import Region

Motion = Callable[[], Float64[ndarray, "4 4"] | None]
"""Returns T_world_source, which may be found later than the sequence is opened; None until then."""


def moved_frame(frame: Frame, T: Float64[ndarray, "4 4"] | None) -> Frame:
    """Return the frame with its pose moved by T; the frame itself without a motion."""
    return frame if T is None else replace(frame, T_world_camera=orthonormal(T @ frame.T_world_camera))


@dataclass(frozen=True, slots=True, eq=False)
class _MovedRegion:
    """A region of the source, for frames in the new world frame."""

    region: Region
    motion: Motion

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the region."""
        T_world_source = self.motion()
        return self.region.mask(moved_frame(frame, None if T_world_source is None else inverse(T_world_source)))


class MovedSource(WrappedSource):
    """A source in another world frame, of this name; as it is until its motion is known."""

    def __init__(self, source: Source, motion: Motion, world_frame: str) -> None:
        super().__init__(source)
        self._motion = motion
        self._world_frame = world_frame

    @property
    def world_frame(self) -> str:
        """The name of the new world frame."""
        return self._source.world_frame if self._motion() is None else self._world_frame

    @property
    def up_axis(self) -> UpAxis:
        """The upward direction in the new world frame."""
        T_world_source = self._motion()
        if T_world_source is None:
            return self._source.up_axis
        x, y, z = T_world_source[:3, :3] @ np.array(self._source.up_axis)
        return unit_up_axis((float(x), float(y), float(z)))

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i with its pose in the new world frame. Raises DatasetError, PoseError."""
        return moved_frame(self._source.frame(i, size), self._motion())

    def trajectory(self) -> Trajectory:
        """Return the poses in the new world frame."""
        trajectory, T_world_source = self._source.trajectory(), self._motion()
        if T_world_source is None:
            return trajectory
        return replace(trajectory, T_world_camera=T_world_source @ trajectory.T_world_camera)

    def regions(self) -> Mapping[str, Region]:
        """Return the regions in the new world frame."""
        return {name: _MovedRegion(region, self._motion) for name, region in self._source.regions().items()}
