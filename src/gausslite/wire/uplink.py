"""Bring a robot's words to the fusion server: in the background, within a bandwidth, until each is acknowledged.

It sends in rounds. A round takes the waiting words whose kappa grew most, sends them as subsets on one stream and
settles what is acknowledged; everything else stays in the spool and goes in a later round. So a lost connection,
a restart of either side or a duplicate needs no special case.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, encode_subset, split_batch
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import FusionClient, Session
from gausslite.wire.spool import Purpose, Spool, SpoolBatch
from gausslite.wire.token_bucket import TokenBucket
from gausslite.wire.uplink_values import UplinkCounters, UplinkSettings

_log = logging.getLogger(__name__)
_MIN_SUBSET_BYTES = 1 << 16
_MIN_INTERVAL_S = 0.02
_LAST_BACKOFF_S = 5.0
_PURPOSES = {Purpose.ROI: pb.PURPOSE_ROI, Purpose.HANDOVER: pb.PURPOSE_HANDOVER}


class Uplink:
    """Owns the spool, the client and one thread. `offer` never waits for the network."""

    def __init__(
        self,
        client: FusionClient,
        agent_id: str,
        spool: Spool,
        grid: VoxelGrid,
        settings: UplinkSettings | None = None,
        has_restored_map: bool = False,
    ) -> None:
        """has_restored_map: the robot has its map from an earlier life, so that what it said then stands."""
        self._client, self._agent_id, self._spool, self._grid = client, agent_id, spool, grid
        self._settings = settings or UplinkSettings()
        self._has_restored_map = has_restored_map
        self._counters = UplinkCounters()
        self._roi_voxels: set[int] = set()
        self._damaged: set[int] = set()
        self._session: Session | None = None
        self._sequence = 0
        self._subset_bytes = MAX_SUBSET_BYTES
        self._token_bucket = TokenBucket(self._settings.kbps)
        self._backoff_s = 0.0
        self._trouble = ""
        self._next_round_s = 0.0
        self._draining = self._closing = self._hurrying = False
        # guards the counters and flags; waited on by the thread and by drain
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def enqueue(self, words: VoxelBatch, purpose: Purpose = Purpose.ROI) -> None:
        """Take these words to be sent; on each voxel they replace what was not sent yet. Raises StorageError."""
        if len(words):
            self._spool.enqueue(words, purpose)
            with self._changed:
                self._changed.notify_all()

    def drain(self, timeout_s: float) -> bool:
        """Send what waits, small changes too; True when the server has everything, False when the time is over."""
        with self._changed:
            self._draining = True
            self._next_round_s = 0.0
            self._changed.notify_all()
            try:
                self._changed.wait_for(self._is_finished, timeout_s)
                return self._spool.waiting == 0
            finally:
                self._draining = False

    def counters(self) -> UplinkCounters:
        """A snapshot."""
        with self._changed:
            return replace(self._counters, voxels_sent=len(self._roi_voxels), voxels_waiting=self._spool.waiting)

    @property
    def session_id(self) -> str:
        """The session in force; empty while there is none."""
        session = self._session
        return "" if session is None else session.session_id

    def cancel_drain(self) -> None:
        """Make `drain` return at once, now and from now on; sending goes on until `close`."""
        with self._changed:
            self._hurrying = True
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread and the connection; what waits stays in the spool."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        # ends a call in flight, so that the thread cannot hang on the network
        self._client.close()
        self._thread.join()
        self._spool.close()

    def _is_finished(self) -> bool:
        return self._hurrying or self._closing or bool(self._counters.stopped_because) or self._spool.waiting == 0

    def _run(self) -> None:
        try:
            while self._wait_until_due():
                try:
                    self._after_round(self._round())
                except (MismatchError, NotPermittedError, InvalidInputError) as error:
                    self._stop(str(error))
                except GaussLiteError as error:
                    if not self._closing:
                        self._recover(error)
        except Exception as error:
            # a channel closed under a call is how `close` ends it
            if not self._closing:
                # whatever else it is, the operator must see that nothing is sent any more
                _log.exception("uplink failed")
                self._stop(f"{type(error).__name__}: {error}")

    def _wait_until_due(self) -> bool:
        """Wait for words, bandwidth and the next round's time; False when it is time to end."""
        with self._changed:
            while not self._closing and not self._counters.stopped_because:
                now_s = time.monotonic()
                wait_s = max(self._next_round_s - now_s, self._token_bucket.seconds_until_positive(now_s))
                if wait_s <= 0 and self._spool.waiting:
                    return True
                self._changed.wait(wait_s if wait_s > 0 else None)
        return False

    def _round(self) -> bool:
        """Join if needed, send one batch, settle what is acknowledged. False when no word was due."""
        resend_threshold = 0.0 if self._draining else self._settings.resend_threshold
        room = self._token_bucket.room(self._settings.round_bytes)
        picked = self._spool.next_batch(room, resend_threshold)
        if picked is None:
            return False
        session = self._joined()
        sent: dict[int, tuple[SpoolBatch, int]] = {}
        requests = list(self._requests(picked, session, sent))
        self._token_bucket.spend(sum(size for _, size in sent.values()))
        problem = self._exchange(requests, sent)
        if problem is not None:
            raise problem
        if sent:
            raise UnavailableError(f"{self._client}: the stream ended before {len(sent)} subsets were answered")
        return True

    def _exchange(
        self, requests: list[pb.ContributeSubsetsRequest], sent: dict[int, tuple[SpoolBatch, int]]
    ) -> GaussLiteError | None:
        """Send on one stream and settle what is answered; the last problem that needs another try."""
        problem: GaussLiteError | None = None
        try:
            for response in self._client.contribute(requests, self._settings.deadline_s):
                for outcome in response.outcomes:
                    if outcome.sequence in sent:
                        problem = self._take_outcome(outcome, *sent.pop(outcome.sequence)) or problem
        except InvalidInputError as error:
            # the server will not have any of it, now or later
            for part, _ in sent.values():
                self._drop(part, str(error))
            sent.clear()
        return problem

    def _joined(self) -> Session:
        if self._session is None:
            # a robot that begins with nothing cannot take back what it said in an earlier life
            fresh = self._spool.is_new and not self._has_restored_map and self._counters.joins == 0
            self._session = self._client.join(self._agent_id, self._grid, self._settings.world_frame, fresh)
            if self._session.highest_map_revision == 0:
                # it has nothing of what an earlier life sent
                self._spool.mark_all_unsent()
            self._sequence = 0
            self._subset_bytes = min(self._subset_bytes, self._session.max_subset_bytes or MAX_SUBSET_BYTES)
            with self._changed:
                self._counters = replace(self._counters, connected=True, joins=self._counters.joins + 1)
        return self._session

    def _requests(
        self, picked: SpoolBatch, session: Session, sent: dict[int, tuple[SpoolBatch, int]]
    ) -> Iterator[pb.ContributeSubsetsRequest]:
        start = 0
        for part in split_batch(picked.words, self._subset_bytes):
            stop = start + len(part)
            self._sequence += 1
            stamp = self._spool.next_update_seq(session.highest_map_revision)
            words = SpoolBatch(picked.purpose, part, picked.versions[start:stop])
            start = stop
            try:
                data = encode_subset(
                    RoiSubset(self._agent_id, session.session_id, self._sequence, stamp, part), self._grid
                )
            except InvalidInputError as error:
                self._drop(words, str(error))
                continue
            sent[self._sequence] = words, len(data)
            yield pb.ContributeSubsetsRequest(
                session_id=session.session_id,
                sequence=self._sequence,
                purpose=_PURPOSES[picked.purpose],
                subset=data,
            )

    def _take_outcome(self, outcome: pb.SubsetOutcome, part: SpoolBatch, size: int) -> GaussLiteError | None:
        """Settle one subset; the error to recover from when it has to be sent again."""
        keys = set(part.words.keys.tolist())
        rejected = outcome.status == pb.SUBSET_STATUS_REJECTED
        self._count(part, size, keys, rejected)
        if rejected and outcome.reason in ("QUOTA", "STORAGE"):
            return QuotaError(outcome.message)
        if rejected and outcome.reason == "CHECKSUM" and not keys & self._damaged:
            self._damaged |= keys
            return UnavailableError(outcome.message)
        self._damaged -= keys
        if rejected:
            self._drop(part, f"{outcome.reason} {outcome.message}")
        else:
            self._spool.mark_acked(part)
        return None

    def _drop(self, part: SpoolBatch, reason: str) -> None:
        _log.warning("uplink: words on %d voxels are dropped: %s", len(part.words), reason)
        self._spool.mark_acked(part)
        with self._changed:
            self._counters = replace(self._counters, subsets_rejected=self._counters.subsets_rejected + 1)

    def _count(self, part: SpoolBatch, size: int, keys: set[int], rejected: bool) -> None:
        is_roi = part.purpose is Purpose.ROI
        with self._changed:
            c = self._counters
            self._counters = replace(
                c,
                roi_bytes=c.roi_bytes + size * is_roi,
                handover_bytes=c.handover_bytes + size * (not is_roi),
                gaussians_sent=c.gaussians_sent + len(part.words.gaussians) * (not rejected),
                subsets_sent=c.subsets_sent + 1,
            )
            if is_roi and not rejected:
                self._roi_voxels |= keys

    def _recover(self, error: GaussLiteError) -> None:
        """Make ready for another try: join anew, send less at once, or just wait."""
        if str(error) != self._trouble:
            # said once and not with every try: a robot may be out of reach for hours
            _log.warning("uplink: %s; will go on trying", error)
            self._trouble = str(error)
        if isinstance(error, SessionUnknownError):
            self._session = None
            self._spool.mark_all_unsent()
        if isinstance(error, (QuotaError, StorageError)):
            self._subset_bytes = max(_MIN_SUBSET_BYTES, self._subset_bytes // 2)
        with self._changed:
            self._counters = replace(self._counters, connected=False)
            self._backoff_s = min(max(2 * self._backoff_s, self._settings.first_backoff_s), _LAST_BACKOFF_S)
            self._next_round_s = time.monotonic() + self._backoff_s

    def _after_round(self, sent: bool) -> None:
        if sent and self._trouble:
            _log.info("uplink: %s takes words again", self._client)
            self._trouble = ""
        with self._changed:
            self._backoff_s = 0.0
            self._counters = replace(self._counters, connected=self._session is not None)
            if not (sent and self._draining):
                self._next_round_s = time.monotonic() + max(self._settings.interval_s, _MIN_INTERVAL_S)
            self._changed.notify_all()

    def _stop(self, reason: str) -> None:
        _log.error("uplink stops: %s", reason)
        with self._changed:
            self._counters = replace(self._counters, connected=False, stopped_because=reason)
            self._changed.notify_all()
