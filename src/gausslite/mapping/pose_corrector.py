"""What corrects the poses of keyframes where one sees an earlier place again: a plug-in of `gausslite.correctors`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import Rasterizer


@dataclass(frozen=True, slots=True)
class LoopCounts:
    """What became of the loops so far."""

    refused: int = 0  # keyframes whose image, or the map, did not agree with the pose of a loop
    accepted: int = 0  # loops that the latest solution of the pose graph keeps
    rejected: int = 0  # loops that it does not keep
    withdrawn: int = 0  # accepted by one solution and rejected by a later one
    corrections: int = 0  # how often the map moved

    def describe(self) -> str:
        """Return the counts as one line; empty while there is nothing to report."""
        if not (self.corrections or self.refused or self.rejected or self.withdrawn):
            return ""
        return (
            f"loops: corrections of the map {self.corrections}; not used: {self.refused} contradict the map, "
            f"{self.rejected} other loops; taken back: {self.withdrawn}"
        )


@runtime_checkable
class PoseCorrector(Protocol):
    """Finds loops among the keyframes of one map. The mapper moves map, keyframes and poses by what it returns."""

    @property
    def counts(self) -> LoopCounts:
        """What became of the loops so far."""

    @property
    def keyframes(self) -> int:
        """The number of keyframes so far."""

    def add(
        self, keyframe: Keyframe, prior: Frame, kept: Sequence[Keyframe], table: SplatTable
    ) -> Float64[ndarray, "k 4 4"] | None:
        """Add the next keyframe; return the motion of each keyframe in world axes if a loop corrects them, else None.

        prior: the frame with the pose before refinement, by the odometry or by tracking. kept: keyframes with images;
        without any, no loop is searched. table: the map, which is only read.
        """

    def begin_another(self) -> PoseCorrector:
        """Return a corrector without keyframes, of the same settings."""

    def joined(self, piece: State, T_map_piece: Float64[ndarray, "4 4"]) -> State:
        """Return this one's state with the keyframes of another one after its own, which move by one motion."""

    def state(self) -> State:
        """Return everything that the next keyframe depends on."""

    def restore(self, state: State) -> None:
        """Continue from another corrector's state. Raises MapFileError, PoseError."""


OpenCorrector = Callable[[Rasterizer, PoseExposurePrior], PoseCorrector]
"""The plug-in; the prior is that of the error of single poses. Raises MissingPluginError without a package it needs."""
