"""One robot's loop over frames, from a posed image to the words that leave the robot, one named step a line."""

from __future__ import annotations

import time
from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.subset import VoxelWords
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.roi import RoiLedger
from gausslite.perception.attention import Attention


@dataclass(frozen=True, slots=True, eq=False)
class FrameOutcome:
    """What became of one frame.

    seconds cover perception and mapping; skipped says why the frame was not mapped, None when it was; words are what
    changed in the task's region, None without a ledger or when the frame was skipped.
    """

    index: int
    iterations: int
    gaussians: int
    roi_share: float
    seconds: float
    skipped: str | None
    words: VoxelWords | None


class TaskMapper:
    """Attends to a frame, maps it, and tells what of the task's region changed. Not thread-safe."""

    def __init__(
        self,
        attention: Attention,
        mapper: GaussianMapper,
        ledger: RoiLedger | None = None,
        seconds_per_frame: float | None = None,
    ) -> None:
        """With seconds_per_frame each frame trains until its time is up instead of a fixed number of iterations."""
        if seconds_per_frame is not None and not seconds_per_frame > 0:
            raise InvalidInputError(f"seconds_per_frame: expected a positive number, got {seconds_per_frame}")
        self._attention = attention
        self._mapper = mapper
        self._ledger = ledger
        self._seconds_per_frame = seconds_per_frame

    @property
    def notes(self) -> tuple[str, ...]:
        """What the attention wants the operator to know."""
        return self._attention.notes

    def gaussians(self) -> Gaussians:
        """A copy of the map."""
        return self._mapper.gaussians()

    def process(self, frame: Frame) -> FrameOutcome:
        """Take one frame from its pixels to the words on its region."""
        started_s = time.perf_counter()
        relevance = self._attention.attend(frame, self._drawn_depth_m(frame))
        mapped = self._mapper.map_frame(frame, relevance, self._seconds_left(started_s))
        words = self._changed_roi() if mapped.skipped is None else None
        return FrameOutcome(
            index=frame.index,
            iterations=mapped.iterations,
            gaussians=mapped.gaussians,
            roi_share=relevance.roi_share,
            seconds=time.perf_counter() - started_s,
            skipped=mapped.skipped,
            words=words,
        )

    def _drawn_depth_m(self, frame: Frame) -> Float32[ndarray, "h w"] | None:
        return self._mapper.expected_depth_m(frame) if self._mapper.count > 0 else None

    def _seconds_left(self, started_s: float) -> float | None:
        if self._seconds_per_frame is None:
            return None
        return max(0.0, started_s + self._seconds_per_frame - time.perf_counter())

    def _changed_roi(self) -> VoxelWords | None:
        return None if self._ledger is None else self._ledger.changed(self._mapper.roi_gaussians())
