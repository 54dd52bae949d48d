"""Answer the streams on which agents send their voxel updates, wherever these are stored; pace large keyframes."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import NamedTuple

from gausslite.domain.errors import GaussLiteError, MismatchError, SessionUnknownError, StorageError, UnavailableError
from gausslite.fusion.limits import SessionRecord
from gausslite.fusion.traffic import TrafficCounters
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.security import Caller, RejectionLog
from gausslite.wire.status import code_and_reason

STREAM_ERRORS = (SessionUnknownError, MismatchError, StorageError, UnavailableError)
"""Errors that every later message would raise too, so they end the stream; other errors reject one message."""
_QUICK_S, _PAUSE = 0.05, 2.0


class StoredCount(NamedTuple):
    """The numbers of voxels of a message that were stored, and that were stale; owner: as in SubsetOutcome."""

    accepted: int
    stale: int
    owner: str = ""


@dataclass(frozen=True, slots=True)
class Contributions:
    """Answers one message after the other of each stream.

    find_session: raises SessionUnknownError, NotPermittedError. store: returns when the message is durable, or raises
    what refuses it.
    """

    find_session: Callable[[str, Caller], Awaitable[SessionRecord]]
    store: Callable[[SessionRecord, bytes], Awaitable[StoredCount]]
    record_traffic: Callable[[str, TrafficCounters], None]
    rejections: RejectionLog

    async def answer(
        self, requests: AsyncIterator[pb.ContributeSubsetsRequest], caller: Caller
    ) -> AsyncIterator[pb.ContributeSubsetsResponse]:
        """Yield one acknowledgement for each message; errors of the whole stream are raised."""
        acknowledged, session = 0, None
        async for request in requests:
            if session is None or session.session_id != request.session_id:
                session = await self.find_session(request.session_id, caller)
            outcome = await self._outcome(request, session, caller)
            acknowledged = max(acknowledged, request.sequence)
            yield pb.ContributeSubsetsResponse(acknowledged=acknowledged, outcomes=[outcome])

    async def _outcome(
        self, request: pb.ContributeSubsetsRequest, session: SessionRecord, caller: Caller
    ) -> pb.SubsetOutcome:
        outcome, size = pb.SubsetOutcome(sequence=request.sequence), len(request.subset)
        is_handover = request.purpose == pb.PURPOSE_HANDOVER
        traffic = TrafficCounters(handover_bytes=size) if is_handover else TrafficCounters(roi_bytes=size)
        try:
            stored = await self.store(session, request.subset)
        except STREAM_ERRORS as error:
            if isinstance(error, UnavailableError):
                self.rejections.record(caller.key, "UNAVAILABLE", str(error))
            raise
        except GaussLiteError as error:
            reason = code_and_reason(error)[1]
            outcome.status, outcome.reason, outcome.message = pb.SUBSET_STATUS_REJECTED, reason, str(error)
            self.rejections.record(caller.key, reason, str(error))
            self.record_traffic(session.agent_id, traffic.plus(TrafficCounters(subsets_rejected=1)))
            return outcome
        is_accepted = stored.accepted > 0 or stored.stale == 0
        outcome.status = pb.SUBSET_STATUS_ACCEPTED if is_accepted else pb.SUBSET_STATUS_STALE
        outcome.accepted_voxels, outcome.stale_voxels, outcome.owner = stored
        counted = TrafficCounters(subsets_accepted=int(is_accepted), subsets_stale=int(not is_accepted))
        self.record_traffic(session.agent_id, traffic.plus(counted))
        return outcome


class PacedLock:
    """Held by one call at a time; after long work the next call waits twice as long, so that others have the disk."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._begin_s = self._free_s = 0.0

    async def __aenter__(self) -> None:
        await self._lock.acquire()
        try:
            await asyncio.sleep(self._free_s - time.monotonic())
        except BaseException:
            self._lock.release()
            raise
        self._begin_s = time.monotonic()

    async def __aexit__(self, *_: object) -> None:
        end_s = time.monotonic()
        if end_s - self._begin_s > _QUICK_S:
            self._free_s = end_s + _PAUSE * (end_s - self._begin_s)
        self._lock.release()
