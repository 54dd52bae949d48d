"""Acknowledge the voxel updates that agents send, wherever these are stored."""

from __future__ import annotations

from typing import NamedTuple

from gausslite.domain.errors import GaussLiteError, MismatchError, SessionUnknownError, StorageError, UnavailableError
from gausslite.fusion.traffic import TrafficCounters, TrafficLog
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.call_limits import RejectionLog
from gausslite.wire.security import Caller
from gausslite.wire.status import code_and_reason

STREAM_ERRORS = (SessionUnknownError, MismatchError, StorageError, UnavailableError)
"""Errors that every later message would raise too, so they end the stream; other errors reject one message."""


class StoredCount(NamedTuple):
    """The numbers of voxels of a message that were stored, and that were stale; owner: as in SubsetOutcome."""

    accepted: int
    stale: int
    owner: str = ""


class Acknowledger:
    """Says what became of each message of one stream, and counts it."""

    def __init__(self, caller: Caller, traffic: TrafficLog, rejections: RejectionLog) -> None:
        self._caller, self._traffic, self._rejections = caller, traffic, rejections
        self._acknowledged = 0

    def accept(
        self, request: pb.ContributeSubsetsRequest, agent_id: str, stored: StoredCount
    ) -> pb.ContributeSubsetsResponse:
        """Return the acknowledgement of a message that is durable."""
        is_accepted = stored.accepted > 0 or stored.stale == 0
        outcome = pb.SubsetOutcome(status=pb.SUBSET_STATUS_ACCEPTED if is_accepted else pb.SUBSET_STATUS_STALE)
        outcome.accepted_voxels, outcome.stale_voxels, outcome.owner = stored
        counted = TrafficCounters(subsets_accepted=int(is_accepted), subsets_stale=int(not is_accepted))
        return self._answer(request, agent_id, outcome, counted)

    def refuse(
        self, request: pb.ContributeSubsetsRequest, agent_id: str, error: GaussLiteError
    ) -> pb.ContributeSubsetsResponse:
        """Return the acknowledgement of a refused message. Raises an error that every later message would meet too."""
        reason = code_and_reason(error)[1]
        # `CallInterceptor` records the errors that end a stream, all but UnavailableError
        if isinstance(error, UnavailableError) or not isinstance(error, STREAM_ERRORS):
            self._rejections.record(self._caller.key, reason, str(error))
        if isinstance(error, STREAM_ERRORS):
            raise error
        outcome = pb.SubsetOutcome(status=pb.SUBSET_STATUS_REJECTED, reason=reason, message=str(error))
        return self._answer(request, agent_id, outcome, TrafficCounters(subsets_rejected=1))

    def _answer(
        self, request: pb.ContributeSubsetsRequest, agent_id: str, outcome: pb.SubsetOutcome, counted: TrafficCounters
    ) -> pb.ContributeSubsetsResponse:
        size = len(request.subset)
        is_handover = request.purpose == pb.PURPOSE_HANDOVER
        received = TrafficCounters(handover_bytes=size) if is_handover else TrafficCounters(roi_bytes=size)
        self._traffic.record(agent_id, received.plus(counted))
        self._acknowledged = max(self._acknowledged, request.sequence)
        outcome.sequence = request.sequence
        return pb.ContributeSubsetsResponse(acknowledged=self._acknowledged, outcomes=[outcome])
