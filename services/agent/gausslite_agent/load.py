"""What a robot does when frames come too fast, and when none comes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gausslite.errors import InvalidInputError


class Drops(StrEnum):
    """Which frame gives way when the queue is full."""

    OLDEST = "oldest"
    NEWEST = "newest"


@dataclass(frozen=True, slots=True)
class LoadSettings:
    """What a robot does when frames come too fast, and when none comes.

    idle_iterations is how many it may train, after each frame, while no other waits; such maps depend on the clock.
    """

    queue_frames: int = 4
    drops: Drops = Drops.OLDEST
    idle_iterations: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.queue_frames <= 1000:
            raise InvalidInputError(f"queue: expected 1 to 1000 frames, got {self.queue_frames}")
        if not 0 <= self.idle_iterations <= 10_000:
            raise InvalidInputError(f"idle: expected 0 to 10000 iterations, got {self.idle_iterations}")
