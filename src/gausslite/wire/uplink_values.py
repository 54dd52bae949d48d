"""What an uplink is told, and what it tells: its settings and its counters."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class UplinkSettings:
    """kbps bounds the bandwidth (kilobits a second; None = no bound). Between rounds at least interval_s pass, so that
    words coalesce; a voxel is sent again once its kappa grew by resend_threshold, or when draining.
    """

    kbps: float | None = None
    interval_s: float = 1.0
    resend_threshold: float = 0.25
    round_bytes: int = 4 << 20
    deadline_s: float = 30.0
    first_backoff_s: float = 0.2
    world_frame: str = ""

    def __post_init__(self) -> None:
        if self.kbps is not None and not self.kbps > 0:
            raise InvalidInputError(f"uplink kbps: expected a positive number, got {self.kbps}")
        if not (self.interval_s >= 0 and self.resend_threshold >= 0 and self.deadline_s > 0 and self.round_bytes > 0):
            raise InvalidInputError(
                "uplink: expected interval and growth of at least 0, and a positive deadline and size"
            )


@dataclass(frozen=True, slots=True)
class UplinkCounters:
    """What was sent and acknowledged so far; voxels_sent counts each voxel of the task's region once."""

    roi_bytes: int = 0
    handover_bytes: int = 0
    gaussians_sent: int = 0
    voxels_sent: int = 0
    voxels_waiting: int = 0
    subsets_sent: int = 0
    subsets_rejected: int = 0
    joins: int = 0
    connected: bool = False
    stopped_because: str = ""

    @property
    def bytes_sent(self) -> int:
        """All subset bytes, resends included."""
        return self.roi_bytes + self.handover_bytes
