"""The settings and the counters of an uplink."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.config.option import option
from gausslite.config.values import read_numbers
from gausslite.datasets.poses import pose_from_quaternion
from gausslite.domain.errors import InvalidInputError, PoseError
from gausslite.wire.spool import SpoolBatch


def read_rigid_transform(text: str) -> Float64[ndarray, "4 4"]:
    """Return the transform of "x,y,z" in metres, or with a quaternion "x,y,z,qx,qy,qz,qw". Raises InvalidInputError."""
    values = np.array(read_numbers(text, 3 if text.count(",") < 3 else 7))
    try:
        return pose_from_quaternion("", values[:3], values[3:] if len(values) == 7 else np.array([0.0, 0.0, 0.0, 1.0]))
    except PoseError:
        raise InvalidInputError(f"expected a quaternion of length 1 as qx,qy,qz,qw, got {text!r}") from None


@dataclass(frozen=True, slots=True)
class UplinkSettings:
    """Limits and intervals of sending.

    interval_s: minimum time between rounds, so that several changes of a voxel are sent as one. resend_threshold:
    change of a voxel's Σkappa, as a share of the sent value, from which it is sent again; 0 while the uplink drains.
    round_bytes: size limit of a round. deadline_s: of each call. first_backoff_s: wait before the first retry.
    check_interval_s: how often an idle uplink asks the server whether it still has everything. T_fused_agent: declared
    pose of the agent's frame in the fused map's; None: not declared.
    """

    kbps: float | None = option(
        None, "bandwidth limit in kilobits per second (default: none)", key="uplink-kbps", unit="kbit/s", low=0.001
    )
    interval_s: float = option(1.0, "time between two transmissions", key="uplink-interval", unit="s", low=0)
    resend_threshold: float = 0.25
    round_bytes: int = 4 << 20
    deadline_s: float = 30.0
    first_backoff_s: float = 0.2
    check_interval_s: float = 10.0
    world_frame: str = option("", "name of the frame of all poses (default: the server's)", metavar="NAME")
    T_fused_agent: Float64[ndarray, "4 4"] | None = option(
        None,
        "pose of this agent's world frame in the fused map's frame, if it is known (default: the same frame)",
        key="fused-from-agent",
        metavar="X,Y,Z[,QX,QY,QZ,QW]",
        plain_type=str,
        convert=read_rigid_transform,
    )

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
