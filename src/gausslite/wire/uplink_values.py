"""The settings and the counters of an uplink."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class UplinkSettings:
    """kbps limits the bandwidth in kilobits per second (None = no limit). Rounds are at least interval_s apart, so that
    several changes of a voxel are sent as one. A voxel is sent again if its Σkappa has changed by the share
    resend_threshold of the sent value, or while the uplink drains.
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
                "uplink: expected an interval and resend threshold of at least 0, and a positive deadline and size"
            )


@dataclass(frozen=True, slots=True)
class UplinkCounters:
    """Totals since the start; voxels_sent counts each voxel of the task's region once."""

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
