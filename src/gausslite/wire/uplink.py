"""Send an agent's voxel updates and keyframes to the fusion server, asynchronously and within one bandwidth.

The uplink sends in rounds. A round takes the updates and keyframes with the highest value per byte from the spool,
sends them and marks the acknowledged ones; the others stay in the spool for a later round. So a lost connection, a
restart of either side and a duplicate need no special case.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, encode_subset, split_batch
from gausslite.domain.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NameInUseError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.domain.free_space import FreeSpace
from gausslite.domain.objects import ObjectReport
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import geometry_pb2
from gausslite.wire.clients import FusionClient, Session
from gausslite.wire.free_space_outbox import FreeSpaceOutbox
from gausslite.wire.object_outbox import ObjectOutbox
from gausslite.wire.retry_delay import RetryDelay
from gausslite.wire.spool import Purpose, Spool, SpoolBatch
from gausslite.wire.spooled_keyframes import SpooledKeyframe
from gausslite.wire.token_bucket import TokenBucket
from gausslite.wire.uplink_values import SentPart, UplinkCounters, UplinkSettings

_log = logging.getLogger(__name__)
_MIN_SUBSET_BYTES = 1 << 16
_MIN_INTERVAL_S = 0.02
_LEAVE_S = 1.0
_PURPOSES = {Purpose.ROI: pb.PURPOSE_ROI, Purpose.HANDOVER: pb.PURPOSE_HANDOVER}


class Uplink:
    """Owns the spool, the client and one thread. `enqueue` never waits for the network."""

    def __init__(
        self,
        client: FusionClient,
        agent_id: str,
        spool: Spool,
        grid: VoxelGrid,
        settings: UplinkSettings | None = None,
        has_restored_map: bool = False,
    ) -> None:
        """has_restored_map: the map was restored from a checkpoint, so that the updates sent before stay valid."""
        self._client, self._agent_id, self._spool, self._grid = client, agent_id, spool, grid
        self._settings = settings or UplinkSettings()
        self._has_restored_map = has_restored_map
        self._counters = UplinkCounters()
        self._roi_voxels: set[int] = set()
        self._resent_damaged: set[int] = set()
        self._session: Session | None = None
        self._message_seq = 0
        self._subset_bytes = MAX_SUBSET_BYTES
        self._token_bucket = TokenBucket(self._settings.kbps)
        self._retry_delay = RetryDelay(self._settings.first_backoff_s)
        self._last_error = ""
        self._next_round_s = 0.0
        self._next_check_s = math.inf
        self._draining = self._closing = False
        self._drain_limit_s = math.inf
        self._sent_keyframes: set[int] = set()
        self._objects = ObjectOutbox()
        self._free_space = FreeSpaceOutbox()
        # guards the counters and flags; waited on by the thread and by drain
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def enqueue(self, batch: VoxelBatch, purpose: Purpose = Purpose.ROI) -> None:
        """Queue voxel updates; each replaces a pending update of its voxel. Raises StorageError."""
        if len(batch):
            self._spool.enqueue(batch, purpose)
            with self._changed:
                self._changed.notify_all()

    def report_objects(self, report: ObjectReport) -> None:
        """Send the agent's task and objects with the next round; a newer report replaces one that waits."""
        if self._objects.put(report):
            with self._changed:
                self._changed.notify_all()

    def enqueue_free_space(self, blocks: FreeSpace) -> None:
        """Send these blocks of free space with the next round; newer ones replace those that wait."""
        if len(blocks.keys):
            self._free_space.put(blocks)
            with self._changed:
                self._changed.notify_all()

    def enqueue_keyframe(self, keyframe: SpooledKeyframe, replaced: int | None = None) -> None:
        """Queue a selected keyframe; replaced: index of the one that it replaces. Raises StorageError."""
        self._spool.enqueue_keyframe(keyframe, replaced)
        with self._changed:
            self._changed.notify_all()

    def selected_keyframes(self) -> list[SpooledKeyframe]:
        """Return all selected keyframes, also those from before a restart."""
        return self._spool.keyframes()

    def drain(self, timeout_s: float) -> bool:
        """Send everything pending, also small changes. True if the server has it all, False after the timeout."""
        with self._changed:
            deadline_s = time.monotonic() + timeout_s
            self._draining = True
            self._next_round_s = 0.0
            self._changed.notify_all()
            try:
                # the limit may change during the wait
                while not self._is_finished():
                    remaining_s = min(deadline_s, self._drain_limit_s) - time.monotonic()
                    if remaining_s <= 0:
                        break
                    self._changed.wait(min(remaining_s, threading.TIMEOUT_MAX))
                return not self._has_pending()
            finally:
                self._draining = False

    def counters(self) -> UplinkCounters:
        """Return the current totals."""
        with self._changed:
            return replace(
                self._counters,
                voxels_sent=len(self._roi_voxels),
                voxels_waiting=self._spool.pending_voxels,
                keyframes_sent=len(self._sent_keyframes),
                keyframes_waiting=self._spool.pending_keyframes,
            )

    def limit_drain(self, timeout_s: float) -> None:
        """Make the current and all later calls of `drain` return by then; sending continues until `close`."""
        with self._changed:
            self._drain_limit_s = time.monotonic() + timeout_s
            self._changed.notify_all()

    def close(self) -> None:
        """Leave the session, end the thread and the connection; pending updates stay in the spool."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(_LEAVE_S)
        # cancels a call in flight, so that the thread does not block on the network
        self._client.close()
        self._thread.join()
        self._spool.close()

    def _is_finished(self) -> bool:
        return self._closing or bool(self._counters.stopped_because) or not self._has_pending()

    def _has_pending(self) -> bool:
        has_others = self._objects.pending is not None or self._free_space.has_pending
        return has_others or self._spool.pending_voxels + self._spool.pending_keyframes > 0

    def _run(self) -> None:
        try:
            while self._wait_until_due():
                try:
                    self._end_round(self._send_round())
                except (MismatchError, NotPermittedError, InvalidInputError) as error:
                    self._stop(str(error))
                except GaussLiteError as error:
                    if not self._closing:
                        self._recover(error)
            if self._session is not None and not self._last_error:
                # ends the lease, so that a robot without its spool can take the name again at once
                self._client.leave(self._session.session_id)
        except Exception as error:
            # `close` makes a call in flight fail
            if not self._closing:
                # the operator must see that nothing is sent any more
                _log.exception("uplink failed")
                self._stop(f"{type(error).__name__}: {error}")

    def _wait_until_due(self) -> bool:
        """Wait for updates, bandwidth and the next round's time; False if the uplink ends."""
        with self._changed:
            while not self._closing and not self._counters.stopped_because:
                now_s = time.monotonic()
                wait_s = max(self._next_round_s - now_s, self._token_bucket.seconds_until_positive(now_s))
                check_in_s = self._next_check_s - now_s
                if wait_s <= 0 and (self._has_pending() or check_in_s <= 0):
                    return True
                self._changed.wait(min(wait_s if wait_s > 0 else check_in_s, threading.TIMEOUT_MAX))
        return False

    def _send_round(self) -> bool:
        """Join if needed, send what is due and mark what is acknowledged. False if nothing was due."""
        if time.monotonic() >= self._next_check_s:
            self._check_server()
        resend_threshold = 0.0 if self._draining else self._settings.resend_threshold
        max_bytes = self._token_bucket.available_bytes(self._settings.round_bytes)
        due = self._spool.next_round(max_bytes, resend_threshold)
        if due is None and self._objects.pending is None and not self._free_space.has_pending:
            return False
        session = self._join_if_needed()
        self._token_bucket.spend(self._objects.send(self._client, session.session_id))
        self._token_bucket.spend(self._free_space.send(self._client, session.session_id, self._grid))
        if due is None:
            return True
        if due.voxels is not None:
            self._send_voxels(due.voxels, session)
        if due.keyframes:
            self._send_keyframes(due.keyframes, session)
        return True

    def _check_server(self) -> None:
        """Ask the server whether it has every acknowledged update; if not, join again and send everything."""
        if self._session is None:
            self._next_check_s = math.inf
            return
        kept = self._client.keep_session(self._session.session_id)
        self._next_check_s = time.monotonic() + self._settings.check_interval_s
        if not self._spool.is_stored_by(kept.incarnation_id, kept.highest_update_seq):
            _log.warning("uplink: %s has lost updates; everything is sent again", self._client)
            self._forget_session()

    def _forget_session(self) -> None:
        """Mark everything as unsent, so that the next round joins again and sends it."""
        self._session = None
        self._spool.mark_all_unsent()
        self._objects.mark_unsent()
        self._free_space.mark_unsent()

    def _send_voxels(self, due: SpoolBatch, session: Session) -> None:
        sent: dict[int, SentPart] = {}
        requests = list(self._requests(due, session, sent))
        self._token_bucket.spend(sum(each.size_bytes for each in sent.values()))
        error = self._exchange(requests, sent)
        if error is not None:
            raise error
        if sent:
            raise UnavailableError(f"{self._client}: the stream ended before {len(sent)} subsets were answered")

    def _send_keyframes(self, due: Sequence[SpooledKeyframe], session: Session) -> None:
        """Send keyframes on one stream. A rejected keyframe is dropped, because it would be rejected again."""
        byte_count = sum(len(each.data) for each in due)
        self._token_bucket.spend(byte_count)
        messages = [geometry_pb2.EncodedFrame.FromString(each.data) for each in due]
        selected = self._spool.keyframe_indices()
        deadline_s = self._settings.deadline_s
        response = self._client.contribute_encoded_keyframes(session.session_id, messages, selected, deadline_s)
        self._spool.mark_keyframes_done(due)
        for each in response.rejected:
            _log.warning("uplink: keyframe %d is dropped: %s", each.index, each.reason)
        rejected = {each.index for each in response.rejected}
        with self._changed:
            self._sent_keyframes |= {each.frame_index for each in due} - rejected
            self._counters = replace(self._counters, keyframe_bytes=self._counters.keyframe_bytes + byte_count)

    def _exchange(
        self, requests: list[pb.ContributeSubsetsRequest], sent: dict[int, SentPart]
    ) -> GaussLiteError | None:
        """Send on one stream and handle the outcomes; returns the last error that needs a retry."""
        error_to_retry: GaussLiteError | None = None
        try:
            for response in self._client.contribute(requests, self._settings.deadline_s):
                for outcome in response.outcomes:
                    if outcome.sequence in sent:
                        error_to_retry = self._handle_outcome(outcome, sent.pop(outcome.sequence)) or error_to_retry
        except InvalidInputError as error:
            # the server refuses these messages permanently
            for each in sent.values():
                self._drop(each.batch, str(error))
            sent.clear()
        return error_to_retry

    def _join_if_needed(self) -> Session:
        if self._session is None:
            # a robot with a new map cannot send tombstones for the updates of its earlier map
            fresh = self._spool.is_new and not self._has_restored_map and self._counters.joins == 0
            report, frame = self._objects.latest, self._settings.world_frame
            task = None if report is None else report.graph
            self._session = self._client.join(
                self._agent_id, self._grid, frame, fresh, task, self._settings.T_fused_agent
            )
            if not self._spool.is_stored_by(self._session.incarnation_id, self._session.highest_update_seq):
                self._spool.begin_sending_to(self._session.incarnation_id)
            self._spool.mark_keyframes_missing(self._session.keyframes)
            self._message_seq = 0
            self._next_check_s = time.monotonic() + self._settings.check_interval_s
            self._subset_bytes = min(self._subset_bytes, self._session.max_subset_bytes or MAX_SUBSET_BYTES)
            with self._changed:
                self._counters = replace(self._counters, connected=True, joins=self._counters.joins + 1)
        return self._session

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
            self._spool.record_acknowledged(sent.update_seq)
        self._count(part, sent.size_bytes, keys, rejected)
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
        with self._changed:
            self._counters = replace(self._counters, subsets_rejected=self._counters.subsets_rejected + 1)

    def _count(self, part: SpoolBatch, size: int, keys: set[int], rejected: bool) -> None:
        is_roi = part.purpose is Purpose.ROI
        with self._changed:
            counters = self._counters
            self._counters = replace(
                counters,
                roi_bytes=counters.roi_bytes + size * is_roi,
                handover_bytes=counters.handover_bytes + size * (not is_roi),
                gaussians_sent=counters.gaussians_sent + len(part.batch.gaussians) * (not rejected),
                subsets_sent=counters.subsets_sent + 1,
            )
            if is_roi and not rejected:
                self._roi_voxels |= keys

    def _recover(self, error: GaussLiteError) -> None:
        """Prepare a retry: join again, send smaller messages, or only wait."""
        if str(error) != self._last_error:
            # logged once and not at every retry, because a robot may be offline for hours
            _log.warning("uplink: %s; retrying", error)
            self._last_error = str(error)
        if isinstance(error, NameInUseError):
            self._session = None
        if isinstance(error, SessionUnknownError):
            self._forget_session()
        if isinstance(error, (QuotaError, StorageError)):
            self._subset_bytes = max(_MIN_SUBSET_BYTES, self._subset_bytes // 2)
        with self._changed:
            self._counters = replace(self._counters, connected=False)
            self._next_round_s = time.monotonic() + self._retry_delay.after(error)

    def _end_round(self, sent: bool) -> None:
        if sent and self._last_error:
            _log.info("uplink: %s accepts updates again", self._client)
            self._last_error = ""
        with self._changed:
            self._retry_delay.reset()
            self._counters = replace(self._counters, connected=self._session is not None)
            if not (sent and self._draining):
                self._next_round_s = time.monotonic() + max(self._settings.interval_s, _MIN_INTERVAL_S)
            self._changed.notify_all()

    def _stop(self, reason: str) -> None:
        _log.error("uplink stopped: %s", reason)
        with self._changed:
            self._counters = replace(self._counters, connected=False, stopped_because=reason)
            self._changed.notify_all()
