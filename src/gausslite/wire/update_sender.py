"""Send a round of voxel updates on one stream, and mark what the server has acknowledged or refused."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace

from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, encode_subset, split_batch
from gausslite.domain.errors import GaussLiteError, InvalidInputError, QuotaError, UnavailableError
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxels import VoxelGrid
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import FusionClient, Session
from gausslite.wire.spool import Purpose, Spool, SpoolBatch
from gausslite.wire.uplink_values import SentPart, UplinkCounters

_log = logging.getLogger(__name__)
_MIN_SUBSET_BYTES = 1 << 16
_PURPOSES = {Purpose.ROI: pb.PURPOSE_ROI, Purpose.HANDOVER: pb.PURPOSE_HANDOVER}
Count = Callable[[Callable[[UplinkCounters], UplinkCounters]], None]
"""Replaces the uplink's counters by what the function returns for them."""


class UpdateSender:
    """Used by the uplink's thread only; the properties may be read by others."""

    def __init__(self, client: FusionClient, spool: Spool, grid: VoxelGrid, deadline_s: float, count: Count) -> None:
        self._client, self._spool, self._grid, self._deadline_s = client, spool, grid, deadline_s
        self._count = count
        self._agent_id = spool.agent_id
        self._roi_voxels: set[int] = set()
        self._resent_damaged: set[int] = set()
        self._message_seq = 0
        self._subset_bytes = MAX_SUBSET_BYTES

    @property
    def sent_roi_voxels(self) -> int:
        """The number of voxels of the task's region that were sent at least once."""
        return len(self._roi_voxels)

    def begin_session(self, max_subset_bytes: int) -> None:
        """Number the messages of a new session from 1; max_subset_bytes: the server's limit, 0 without one."""
        self._message_seq = 0
        self._subset_bytes = min(self._subset_bytes, max_subset_bytes or MAX_SUBSET_BYTES)

    def halve_messages(self) -> None:
        """Send smaller messages from now on."""
        self._subset_bytes = max(_MIN_SUBSET_BYTES, self._subset_bytes // 2)

    def encode(
        self, due: SpoolBatch, session: Session
    ) -> tuple[list[pb.ContributeSubsetsRequest], dict[int, SentPart]]:
        """Return the messages of a round, and by sequence what each one holds; invalid updates are dropped."""
        sent: dict[int, SentPart] = {}
        return list(self._requests(due, session, sent)), sent

    def send(self, requests: list[pb.ContributeSubsetsRequest], sent: dict[int, SentPart]) -> None:
        """Send the messages and handle their outcomes. Raises the error that needs a retry, UnavailableError."""
        error = self._exchange(requests, sent)
        if error is not None:
            raise error
        if sent:
            raise UnavailableError(f"{self._client}: the stream ended before {len(sent)} subsets were answered")

    def _exchange(
        self, requests: list[pb.ContributeSubsetsRequest], sent: dict[int, SentPart]
    ) -> GaussLiteError | None:
        """Send on one stream and handle the outcomes; returns the last error that needs a retry."""
        error_to_retry: GaussLiteError | None = None
        try:
            for response in self._client.contribute(requests, self._deadline_s):
                for outcome in response.outcomes:
                    if outcome.sequence in sent:
                        error_to_retry = self._handle_outcome(outcome, sent.pop(outcome.sequence)) or error_to_retry
        except InvalidInputError as error:
            # the server refuses these messages permanently
            for each in sent.values():
                self._drop(each.batch, str(error))
            sent.clear()
        return error_to_retry

    def _requests(
        self, due: SpoolBatch, session: Session, sent: dict[int, SentPart]
    ) -> Iterator[pb.ContributeSubsetsRequest]:
        start = 0
        for part in split_batch(due.batch, self._subset_bytes):
            stop = start + len(part)
            self._message_seq += 1
            update_seq = self._spool.next_update_seq(session.highest_update_seq)
            spooled = SpoolBatch(due.purpose, part, due.enqueue_counts[start:stop])
            start = stop
            try:
                data = encode_subset(
                    RoiSubset(self._agent_id, session.session_id, self._message_seq, update_seq, part), self._grid
                )
            except InvalidInputError as error:
                self._drop(spooled, str(error))
                continue
            sent[self._message_seq] = SentPart(spooled, len(data), update_seq)
            yield pb.ContributeSubsetsRequest(
                session_id=session.session_id,
                sequence=self._message_seq,
                purpose=_PURPOSES[due.purpose],
                subset=data,
            )

    def _handle_outcome(self, outcome: pb.SubsetOutcome, sent: SentPart) -> GaussLiteError | None:
        """Mark one subset as acknowledged or dropped; returns the error if it must be sent again."""
        part = sent.batch
        keys = set(part.batch.keys.tolist())
        rejected = outcome.status == pb.SUBSET_STATUS_REJECTED
        if outcome.status == pb.SUBSET_STATUS_ACCEPTED:
            self._spool.record_acknowledged(part.batch.keys, sent.update_seq)
        self._count_sent(part, sent.size_bytes, keys, rejected)
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
        self._count(lambda counters: replace(counters, subsets_rejected=counters.subsets_rejected + 1))

    def _count_sent(self, part: SpoolBatch, size: int, keys: set[int], rejected: bool) -> None:
        is_roi = part.purpose is Purpose.ROI
        self._count(
            lambda counters: replace(
                counters,
                roi_bytes=counters.roi_bytes + size * is_roi,
                handover_bytes=counters.handover_bytes + size * (not is_roi),
                gaussians_sent=counters.gaussians_sent + len(part.batch.gaussians) * (not rejected),
                subsets_sent=counters.subsets_sent + 1,
            )
        )
        if is_roi and not rejected:
            self._roi_voxels |= keys
