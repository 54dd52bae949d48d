"""The settings and the counters of an uplink."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.wire.spool import SpoolBatch


@dataclass(frozen=True, slots=True)
class UplinkSettings:
    """Limits and intervals of sending.

    kbps: bandwidth limit in kilobits per second, None without a limit. interval_s: minimum time between rounds, so that
    several changes of a voxel are sent as one. resend_threshold: change of a voxel's Σkappa, as a share of the sent
    value, from which it is sent again; 0 while the uplink drains. round_bytes: size limit of a round. deadline_s: of
    each call. first_backoff_s: wait before the first retry. check_interval_s: how often an idle uplink asks the server
    whether it still has everything. T_fused_agent: declared pose of the agent's frame in the fused map's; None: not
    declared.
    """

    kbps: float | None = None
    interval_s: float = 1.0
    resend_threshold: float = 0.25
    round_bytes: int = 4 << 20
    deadline_s: float = 30.0
    first_backoff_s: float = 0.2
    check_interval_s: float = 10.0
    world_frame: str = ""
    T_fused_agent: Float64[ndarray, "4 4"] | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.kbps is not None and not self.kbps > 0:
            raise InvalidInputError(f"uplink kbps: expected a positive number, got {self.kbps}")
        if not (self.interval_s >= 0 and self.resend_threshold >= 0 and self.deadline_s > 0 and self.round_bytes > 0):
            raise InvalidInputError(
                "uplink: expected an interval and resend threshold of at least 0, and a positive deadline and size"
            )


@dataclass(frozen=True, slots=True)
class UplinkCounters:
    """Totals since the start.

    voxels_sent counts each voxel of the task's region once; voxels_waiting: voxels in the spool with a pending update.
    keyframes_sent counts each acknowledged keyframe once; keyframe_bytes has their bytes, resends included.
    stopped_because: the error that stopped the uplink, empty while it runs.
    """

    roi_bytes: int = 0
    handover_bytes: int = 0
    gaussians_sent: int = 0
    voxels_sent: int = 0
    voxels_waiting: int = 0
    keyframes_sent: int = 0
    keyframes_waiting: int = 0
    keyframe_bytes: int = 0
    subsets_sent: int = 0
    subsets_rejected: int = 0
    joins: int = 0
    connected: bool = False
    stopped_because: str = ""

    @property
    def bytes_sent(self) -> int:
        """All subset bytes, resends included."""
        return self.roi_bytes + self.handover_bytes


@dataclass(frozen=True, slots=True, eq=False)
class SentPart:
    """A message that waits for its outcome."""

    batch: SpoolBatch
    size_bytes: int
    update_seq: int
