"""Send a round of voxel updates on one stream, and mark what the server has acknowledged or refused."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, encode_subset, split_batch
from gausslite.config.option import option
from gausslite.config.values import read_numbers
from gausslite.datasets.pose_track import pose_from_quaternion
from gausslite.domain.errors import GaussLiteError, InvalidInputError, PoseError, QuotaError, UnavailableError
from gausslite.domain.voxels import RoiSubset, VoxelGrid
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import UNKNOWN, FusionClient, Session
from gausslite.wire.convert import enum_numbers
from gausslite.wire.spool import Purpose, Spool, SpoolBatch

_log = logging.getLogger(__name__)
_MIN_SUBSET_BYTES = 1 << 16
_PURPOSES = enum_numbers(pb.Purpose, Purpose)


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

    resend_threshold: change of a voxel's Σkappa, in units of the sent value, from which it is sent again, see
    `Spool.next_round`; 0 while the uplink drains.
    """

    kbps: float | None = option(
        None, "bandwidth limit in kilobits per second (default: none)", key="uplink-kbps", unit="kbit/s", low=0.001
    )
    interval_s: float = 1.0  # minimum time between rounds, so that several changes of a voxel are sent as one
    resend_threshold: float = 3.0  # bytes of the whole maps: 2 sends 5 % more, 4 sends 4 % fewer, see results of teams
    round_bytes: int = 4 << 20  # size limit of a round
    deadline_s: float = 30.0  # of each call
    first_backoff_s: float = 0.2  # wait before the first retry
    check_interval_s: float = 10.0  # how often an idle uplink asks the server whether it still has everything
    world_frame: str = option("", "name of the frame of all poses (default: the server's)", metavar="NAME")
    T_fused_agent: Float64[ndarray, "4 4"] | None = option(
        None,
        "pose of this agent's world frame in the fused map's frame, if it is known (default: the same frame)",
        key="fused-from-agent",
        metavar="X,Y,Z[,QX,QY,QZ,QW]",
        plain_type=str,
        convert=read_rigid_transform,
        excludes="frame",
    )  # declared pose of the agent's frame in the fused map's; None: not declared
    frame: str = option(
        "team", "the agent's world frame; the server searches the pose of an unknown one", choices=("team", UNKNOWN)
    )  # whether the agent's frame is the team's

    @property
    def declared_frame(self) -> Float64[ndarray, "4 4"] | Literal["unknown"] | None:
        """What the agent says of its frame when it joins, see `FusionClient.join`."""
        return UNKNOWN if self.frame == UNKNOWN else self.T_fused_agent


@dataclass(frozen=True, slots=True)
class UplinkCounters:
    """Totals since the start.

    voxels_sent counts each voxel of the task's region once; voxels_waiting: voxels in the spool with a pending update.
    keyframes_sent counts each acknowledged keyframe once; keyframe_bytes has their bytes, resends included.
    """

    roi_bytes: int = 0  # of the region's voxels, while the mission runs
    handover_bytes: int = 0  # of the rest, after it
    gaussians_sent: int = 0
    voxels_sent: int = 0
    voxels_waiting: int = 0
    keyframes_sent: int = 0
    keyframes_waiting: int = 0
    keyframe_bytes: int = 0
    subsets_sent: int = 0
    subsets_rejected: int = 0
    joins: int = 0  # sessions that were opened
    connected: bool = False
    stopped_because: str = ""  # the error that stopped the uplink, empty while it runs

    @property
    def bytes_sent(self) -> int:
        """All subset bytes, resends included."""
        return self.roi_bytes + self.handover_bytes


@dataclass(frozen=True, slots=True, eq=False)
class SentPart:
    """A message that waits for its outcome."""

    batch: SpoolBatch
    request: pb.ContributeSubsetsRequest
    update_seq: int  # the highest one in the message


class UpdateSender:
    """Used by the uplink's thread only; others may read the counters."""

    def __init__(self, client: FusionClient, spool: Spool, grid: VoxelGrid, deadline_s: float) -> None:
        self._client, self._spool, self._grid, self._deadline_s = client, spool, grid, deadline_s
        self.counters = UplinkCounters()
        """What the outcomes of messages add to the uplink's."""
        self._roi_voxels: set[int] = set()
        self._resent_damaged: set[int] = set()
        self._message_seq = 0
        self._subset_bytes = MAX_SUBSET_BYTES

    def begin_session(self, max_subset_bytes: int) -> None:
        """Number the messages of a new session from 1; max_subset_bytes: the server's limit, 0 without one."""
        self._message_seq = 0
        self._subset_bytes = min(self._subset_bytes, max_subset_bytes or MAX_SUBSET_BYTES)

    def halve_messages(self) -> None:
        """Send smaller messages from now on."""
        self._subset_bytes = max(_MIN_SUBSET_BYTES, self._subset_bytes // 2)

    def encode(self, due: SpoolBatch, session: Session) -> dict[int, SentPart]:
        """Return the messages of a round by their numbers; invalid updates are dropped."""
        parts: dict[int, SentPart] = {}
        start = 0
        for part in split_batch(due.batch, self._subset_bytes):
            spooled = SpoolBatch(due.purpose, part, due.enqueue_counts[start : start + len(part)])
            start += len(part)
            self._message_seq += 1
            number, update_seq = self._message_seq, self._spool.next_update_seq(session.highest_update_seq)
            subset = RoiSubset(self._spool.agent_id, session.session_id, number, update_seq, part)
            try:
                data = encode_subset(subset, self._grid)
            except InvalidInputError as error:
                self._drop(spooled, str(error))
                continue
            request = pb.ContributeSubsetsRequest(
                session_id=session.session_id, sequence=number, purpose=_PURPOSES[due.purpose], subset=data
            )
            parts[number] = SentPart(spooled, request, update_seq)
        return parts

    def send(self, sent: dict[int, SentPart]) -> None:
        """Send the messages on one stream and handle their outcomes. Raises the last error that needs a retry."""
        requests = [part.request for part in sent.values()]
        error_to_retry: GaussLiteError | None = None
        try:
            for response in self._client.contribute(requests, self._deadline_s):
                for outcome in response.outcomes:
                    if outcome.sequence in sent:
                        error_to_retry = self._handle_outcome(outcome, sent.pop(outcome.sequence)) or error_to_retry
        except InvalidInputError as error:
            # the server refuses these messages permanently
            for unanswered in sent.values():
                self._drop(unanswered.batch, str(error))
            sent.clear()
        if error_to_retry is None and sent:
            error_to_retry = UnavailableError(
                f"{self._client}: the stream ended before {len(sent)} subsets were answered"
            )
        if error_to_retry is not None:
            raise error_to_retry

    def _handle_outcome(self, outcome: pb.SubsetOutcome, sent: SentPart) -> GaussLiteError | None:
        """Mark one subset as acknowledged or dropped; returns the error if it must be sent again."""
        part = sent.batch
        keys = set(part.batch.keys.tolist())
        rejected = outcome.status == pb.SUBSET_STATUS_REJECTED
        if outcome.status == pb.SUBSET_STATUS_ACCEPTED:
            self._spool.record_acknowledged(part.batch.keys, sent.update_seq)
        self._count_sent(part, len(sent.request.subset), keys, rejected)
        if rejected and outcome.reason in ("QUOTA", "STORAGE"):
            return QuotaError(outcome.message)
        if rejected and outcome.reason == "CHECKSUM" and not keys & self._resent_damaged:
            self._resent_damaged |= keys
            return UnavailableError(outcome.message)
        self._resent_damaged -= keys
        if rejected:
            self._drop(part, f"{outcome.reason} {outcome.message}")
        else:
            self._spool.mark_done(part)
        return None

    def _drop(self, part: SpoolBatch, reason: str) -> None:
        _log.warning("uplink: updates of %d voxels are dropped: %s", len(part.batch), reason)
        self._spool.mark_done(part)
        self.counters = replace(self.counters, subsets_rejected=self.counters.subsets_rejected + 1)

    def _count_sent(self, part: SpoolBatch, size: int, keys: set[int], rejected: bool) -> None:
        before, is_roi = self.counters, part.purpose is Purpose.ROI
        if is_roi and not rejected:
            self._roi_voxels |= keys
        self.counters = replace(
            before,
            roi_bytes=before.roi_bytes + size * is_roi,
            handover_bytes=before.handover_bytes + size * (not is_roi),
            gaussians_sent=before.gaussians_sent + len(part.batch.gaussians) * (not rejected),
            voxels_sent=len(self._roi_voxels),
            subsets_sent=before.subsets_sent + 1,
        )
