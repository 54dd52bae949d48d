"""Send a robot's voxel updates to the fusion server: asynchronously, within a bandwidth, until each is acknowledged.

The uplink sends in rounds. A round takes the voxels with the largest change of Σkappa from the spool, sends them as
subsets on one stream and marks the acknowledged ones; the others stay in the spool for a later round. So a lost
connection, a restart of either side and a duplicate need no special case.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, encode_subset, split_batch
from gausslite.domain.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import FusionClient, Session
from gausslite.wire.spool import Purpose, Spool, SpoolBatch
from gausslite.wire.token_bucket import TokenBucket
from gausslite.wire.uplink_values import UplinkCounters, UplinkSettings

_log = logging.getLogger(__name__)
_MIN_SUBSET_BYTES = 1 << 16
_MIN_INTERVAL_S = 0.02
_MAX_BACKOFF_S = 5.0
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
        self._sequence = 0
        self._subset_bytes = MAX_SUBSET_BYTES
        self._token_bucket = TokenBucket(self._settings.kbps)
        self._backoff_s = 0.0
        self._last_error = ""
        self._next_round_s = 0.0
        self._draining = self._closing = self._drain_cancelled = False
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

    def drain(self, timeout_s: float) -> bool:
        """Send all pending updates, also small changes. True if the server has them all, False after the timeout."""
        with self._changed:
            self._draining = True
            self._next_round_s = 0.0
            self._changed.notify_all()
            try:
                self._changed.wait_for(self._is_finished, timeout_s)
                return self._spool.pending_voxels == 0
            finally:
                self._draining = False

    def counters(self) -> UplinkCounters:
        """Return the current totals."""
        with self._changed:
            return replace(self._counters, voxels_sent=len(self._roi_voxels), voxels_waiting=self._spool.pending_voxels)

    @property
    def session_id(self) -> str:
        """The id of the current session; empty without one."""
        session = self._session
        return "" if session is None else session.session_id

    def cancel_drain(self) -> None:
        """Make the current and all later calls of `drain` return at once; sending continues until `close`."""
        with self._changed:
            self._drain_cancelled = True
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread and the connection; pending updates stay in the spool."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        # cancels a call in flight, so that the thread does not block on the network
        self._client.close()
        self._thread.join()
        self._spool.close()

    def _is_finished(self) -> bool:
        cannot_send = self._drain_cancelled or self._closing or bool(self._counters.stopped_because)
        return cannot_send or self._spool.pending_voxels == 0

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
                if wait_s <= 0 and self._spool.pending_voxels:
                    return True
                self._changed.wait(wait_s if wait_s > 0 else None)
        return False

    def _send_round(self) -> bool:
        """Join if needed, send one batch and mark the acknowledged updates. False if no voxel was due."""
        resend_threshold = 0.0 if self._draining else self._settings.resend_threshold
        max_bytes = self._token_bucket.available_bytes(self._settings.round_bytes)
        due = self._spool.next_batch(max_bytes, resend_threshold)
        if due is None:
            return False
        session = self._join_if_needed()
        sent: dict[int, tuple[SpoolBatch, int]] = {}
        requests = list(self._requests(due, session, sent))
        self._token_bucket.spend(sum(size for _, size in sent.values()))
        error = self._exchange(requests, sent)
        if error is not None:
            raise error
        if sent:
            raise UnavailableError(f"{self._client}: the stream ended before {len(sent)} subsets were answered")
        return True

    def _exchange(
        self, requests: list[pb.ContributeSubsetsRequest], sent: dict[int, tuple[SpoolBatch, int]]
    ) -> GaussLiteError | None:
        """Send on one stream and handle the outcomes; returns the last error that needs a retry."""
        error_to_retry: GaussLiteError | None = None
        try:
            for response in self._client.contribute(requests, self._settings.deadline_s):
                for outcome in response.outcomes:
                    if outcome.sequence in sent:
                        error_to_retry = self._handle_outcome(outcome, *sent.pop(outcome.sequence)) or error_to_retry
        except InvalidInputError as error:
            # the server refuses these messages permanently
            for part, _ in sent.values():
                self._drop(part, str(error))
            sent.clear()
        return error_to_retry

    def _join_if_needed(self) -> Session:
        if self._session is None:
            # a robot with a new map cannot send tombstones for the updates of its earlier map
            fresh = self._spool.is_new and not self._has_restored_map and self._counters.joins == 0
            self._session = self._client.join(self._agent_id, self._grid, self._settings.world_frame, fresh)
            if self._session.highest_map_revision == 0:
                # the server has no updates of this agent
                self._spool.mark_all_unsent()
            self._sequence = 0
            self._subset_bytes = min(self._subset_bytes, self._session.max_subset_bytes or MAX_SUBSET_BYTES)
            with self._changed:
                self._counters = replace(self._counters, connected=True, joins=self._counters.joins + 1)
        return self._session

    def _requests(
        self, due: SpoolBatch, session: Session, sent: dict[int, tuple[SpoolBatch, int]]
    ) -> Iterator[pb.ContributeSubsetsRequest]:
        start = 0
        for part in split_batch(due.batch, self._subset_bytes):
            stop = start + len(part)
            self._sequence += 1
            map_revision = self._spool.next_update_seq(session.highest_map_revision)
            spooled = SpoolBatch(due.purpose, part, due.versions[start:stop])
            start = stop
            try:
                data = encode_subset(
                    RoiSubset(self._agent_id, session.session_id, self._sequence, map_revision, part), self._grid
                )
            except InvalidInputError as error:
                self._drop(spooled, str(error))
                continue
            sent[self._sequence] = spooled, len(data)
            yield pb.ContributeSubsetsRequest(
                session_id=session.session_id,
                sequence=self._sequence,
                purpose=_PURPOSES[due.purpose],
                subset=data,
            )

    def _handle_outcome(self, outcome: pb.SubsetOutcome, part: SpoolBatch, size: int) -> GaussLiteError | None:
        """Mark one subset as acknowledged or dropped; returns the error if it must be sent again."""
        keys = set(part.batch.keys.tolist())
        rejected = outcome.status == pb.SUBSET_STATUS_REJECTED
        self._count(part, size, keys, rejected)
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
        if isinstance(error, SessionUnknownError):
            self._session = None
            self._spool.mark_all_unsent()
        if isinstance(error, (QuotaError, StorageError)):
            self._subset_bytes = max(_MIN_SUBSET_BYTES, self._subset_bytes // 2)
        with self._changed:
            self._counters = replace(self._counters, connected=False)
            self._backoff_s = min(max(2 * self._backoff_s, self._settings.first_backoff_s), _MAX_BACKOFF_S)
            self._next_round_s = time.monotonic() + self._backoff_s

    def _end_round(self, sent: bool) -> None:
        if sent and self._last_error:
            _log.info("uplink: %s accepts updates again", self._client)
            self._last_error = ""
        with self._changed:
            self._backoff_s = 0.0
            self._counters = replace(self._counters, connected=self._session is not None)
            if not (sent and self._draining):
                self._next_round_s = time.monotonic() + max(self._settings.interval_s, _MIN_INTERVAL_S)
            self._changed.notify_all()

    def _stop(self, reason: str) -> None:
        _log.error("uplink stopped: %s", reason)
        with self._changed:
            self._counters = replace(self._counters, connected=False, stopped_because=reason)
            self._changed.notify_all()
