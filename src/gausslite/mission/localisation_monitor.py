"""Does a mission know where its robot is? A plug-in of `gausslite.monitors` judges each frame before it is mapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol, runtime_checkable

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.state import State
from gausslite.mapping.mapper import FrameView, GaussianMapper

UNPLACED: Final = "the robot's place in the map is not known"


class LocalisationState(IntEnum):
    """Frames of a robot that is not tracked are not mapped; of a lost one, the place is searched."""

    TRACKED = 0
    DOUBTFUL = 1
    LOST = 2


@dataclass(frozen=True, slots=True, eq=False)
class Admission:
    """The frames to map now, oldest first; without any, the reason."""

    frames: Sequence[Frame] = ()
    T_map_odometry: Float64[ndarray, "4 4"] | None = None  # of a robot that was found again
    reason: str = UNPLACED
    joined: State | None = None  # of the mapper, with a piece of map that was begun apart and has its place now
    mapped_apart: int = 0  # frames of this piece


@runtime_checkable
class LocalisationMonitor(Protocol):
    """Compares each frame with the map, and finds the place of a lost robot in it. Not thread-safe."""

    @property
    def localisation(self) -> LocalisationState:
        """The state after the latest frame."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What happened to the localisation so far, one line each."""

    def admit(self, frame: Frame, mapper: GaussianMapper) -> Admission:
        """Return which frames are to be mapped now; frame: with the odometry's pose. The mapper is only read."""

    def confirm(self, frame: Frame, view: FrameView) -> bool:
        """Return False if a frame, as it was placed, contradicts the map rendered there: it is not mapped then."""

    def state(self) -> State:
        """Return what the next frame depends on, without the images that wait."""

    def restore(self, state: State) -> None:
        """Continue from another monitor's state. Raises MapFileError, PoseError."""
