"""Settings for load: what happens if frames arrive too fast, and if none arrive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gausslite.domain.errors import InvalidInputError


class QueuePolicy(StrEnum):
    """Which waiting frame a full queue drops."""

    OLDEST = "oldest"
    NEWEST = "newest"


@dataclass(frozen=True, slots=True)
class LoadSettings:
    """Length and policy of the frame queue, and training while it is empty.

    idle_iterations: the most iterations after each frame while no other frame waits. Maps then depend on the clock.
    free_space: observe the free space of every fifth frame, for the fusion server.
    """

    queue_frames: int = 4
    queue_policy: QueuePolicy = QueuePolicy.OLDEST
    idle_iterations: int = 0
    free_space: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.queue_frames <= 1000:
            raise InvalidInputError(f"queue: expected 1 to 1000 frames, got {self.queue_frames}")
        if not 0 <= self.idle_iterations <= 10_000:
            raise InvalidInputError(f"idle_iterations: expected 0 to 10000, got {self.idle_iterations}")
