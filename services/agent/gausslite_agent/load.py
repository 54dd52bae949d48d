"""Settings for load: what happens if frames arrive too fast, and if none arrive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gausslite.config.option import check_options, option


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

    queue_frames: int = option(4, "length of the frame queue", key="queue", low=1, high=1000)
    queue_policy: QueuePolicy = option(QueuePolicy.OLDEST, "frame that a full queue drops")
    idle_iterations: int = option(
        0,
        "training iterations while the queue is empty (default: 64 at a rate, else 0)",
        low=0,
        high=10_000,
    )
    free_space: bool = option(
        False, "send what the camera has observed as free: it shows frames that do not fit (default: true)"
    )

    def __post_init__(self) -> None:
        check_options(self)
