"""How a mission ends, and what was sent and left when it has ended."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from gausslite.domain.errors import InvalidInputError
from gausslite.wire.uplink_values import UplinkCounters

MAX_DRAIN_S = 86400.0


@dataclass(frozen=True, slots=True)
class EndRequest:
    """handover: also send the rest of the map; drain_s: the longest time for sending."""

    handover: bool
    drain_s: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.drain_s) and 0 <= self.drain_s <= MAX_DRAIN_S):
            raise InvalidInputError(f"drain_seconds: expected 0 to {MAX_DRAIN_S:.0f}, got {self.drain_s}")


@dataclass(frozen=True, slots=True)
class MissionSummary:
    """The figures of a mission that has ended.

    ended_by: why it ended early, None after its regular end. uplink: None without a fusion server. spool: file of the
    data that was left, None if it is in memory.
    """

    frames: int
    hz: float
    gaussians: int
    ended_by: str | None
    uplink: UplinkCounters | None
    spool: Path | None

    @property
    def is_complete(self) -> bool:
        """True if the server has acknowledged everything."""
        uplink = self.uplink
        return uplink is None or (uplink.voxels_waiting == 0 and uplink.keyframes_waiting == 0)

    def line(self) -> str:
        """Return one line for the operator: what was mapped, what was sent, what was left and where it is."""
        ending = "ended" if self.ended_by is None else f"ended early ({self.ended_by})"
        mapped = f"mission {ending}: {self.frames} frames at {self.hz:.2f} Hz, {self.gaussians} Gaussians"
        uplink = self.uplink
        if uplink is None:
            return mapped
        sent = (
            f"{uplink.voxels_sent} voxels of the task's region in {uplink.roi_bytes} bytes, "
            f"{uplink.keyframes_sent} keyframes in {uplink.keyframe_bytes} bytes, "
            f"a handover of {uplink.handover_bytes} bytes"
        )
        return f"{mapped}; sent {sent}; {self._left(uplink)}"

    def _left(self, uplink: UplinkCounters) -> str:
        if self.is_complete:
            return "nothing was left"
        stays = f"in {self.spool} until the agent runs again" if self.spool is not None else "lost when the agent ends"
        return f"left {uplink.voxels_waiting} voxels and {uplink.keyframes_waiting} keyframes, {stays}"
