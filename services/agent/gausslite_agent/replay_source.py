"""The sequence that stands in for the robot's camera; what is wrong with it is told before anything is served."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.open import open_source
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis
from gausslite_agent.settings import PlaySettings


@dataclass(frozen=True, slots=True)
class ReplaySource:
    """A sequence, which of its frames are mapped, and the size of their images."""

    source: Source
    positions: Sequence[int]
    size: tuple[int, int]

    @classmethod
    def open(cls, play: PlaySettings, up_axis: UpAxis | None) -> ReplaySource:
        """Look at a folder, or at the settings of a simulated home. Raises DatasetError, InvalidInputError."""
        return cls.of(open_source(play.source, up_axis, play.depth_registration), play)

    @classmethod
    def of(cls, source: Source, play: PlaySettings) -> ReplaySource:
        """The chosen frames of a sequence. Raises DatasetError when there are none, InvalidInputError."""
        positions: Sequence[int] = select_frames(source, play.frames)
        if play.hold_out is not None:
            positions, _ = HeldOutSplit(play.hold_out).split(positions)
        return cls(source, positions, frame_size(play.size, source))

    def frames(self, after_index: int = -1) -> Iterator[Frame]:
        """Those with greater numbers, each read when it is asked for. Raises DatasetError for a damaged one."""
        indices = self.source.indices()
        chosen = (position for position in self.positions if indices[position] > after_index)
        return (self.source.frame(position, self.size) for position in chosen)
