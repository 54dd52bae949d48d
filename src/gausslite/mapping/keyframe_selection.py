"""The protocol of what chooses the keyframes that a robot sends, a plug-in of `gausslite.keyframe_selections`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.keyframes import Keyframe

MIN_GAIN_SHARE = 0.25
"""Share of a keyframe's own coverage that must be new during a mission."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAddition:
    """A keyframe to add to the selection and to send.

    coverage: what it sees, for a restart. gain: value of what it adds, in units of kappa. replaced: index of the
    keyframe that it replaces, or None.
    """

    keyframe: Keyframe
    coverage: bytes
    gain: float
    replaced: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SelectedKeyframe:
    """A keyframe selected before a restart, and the pose with which it was sent."""

    coverage: bytes
    T_world_camera: Float64[ndarray, "4 4"]


class KeyframeSelection(Protocol):
    """The keyframes that a server has of one robot."""

    def select(self, keyframe: Keyframe, min_gain_share: float = MIN_GAIN_SHARE) -> KeyframeAddition | None:
        """Select the keyframe if that share of it is new, or if its pose has been corrected since it was selected."""


OpenSelection = Callable[[int, VoxelGrid, Mapping[int, SelectedKeyframe]], KeyframeSelection]
"""The plug-in: the most keyframes, and those that were selected before a restart, by frame index."""
