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
from collections.abc import Sequence
from dataclasses import replace

from gausslite.domain import errors
from gausslite.domain.objects import ObjectReport
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.v1 import geometry_pb2
from gausslite.wire.call_limits import TokenBucket
from gausslite.wire.channel import RetryDelay
from gausslite.wire.clients import FusionClient, Session
from gausslite.wire.spool import Purpose, Spool, SpooledKeyframe
from gausslite.wire.update_sender import UpdateSender, UplinkCounters, UplinkSettings

_log = logging.getLogger(__name__)
_MIN_INTERVAL_S = 0.02
_LEAVE_S = 1.0


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
        self.client, self.agent_id, self._grid = client, agent_id, grid
        self.spool = spool
        """What waits, and what the server has."""
        self._settings = settings or UplinkSettings()
        self._has_restored_map = has_restored_map
        self._connected, self._stopped_because = False, ""
        self._joins = self._keyframe_bytes = 0
        self._session: Session | None = None
        self._sender = UpdateSender(client, spool, grid, self._settings.deadline_s)
        self._token_bucket = TokenBucket(self._settings.kbps)
        self._retry_delay = RetryDelay(self._settings.first_backoff_s)
        self._last_error = ""
        self._next_round_s = 0.0
        self._next_check_s = math.inf
        self._draining = self._closing = False
        self._drain_limit_s = math.inf
        self._sent_keyframes: set[int] = set()
        # the latest report of objects, and the one that the server has
        self._report: ObjectReport | None = None
        self._sent_report: ObjectReport | None = None
        self._frame_message, self._localisation = "", "tracked"
        # guards the counters and flags; waited on by the thread and by drain
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def enqueue(self, batch: VoxelBatch, purpose: Purpose = Purpose.ROI) -> None:
        """Queue voxel updates; each replaces a pending update of its voxel. Raises StorageError."""
        if len(batch):
            self.spool.enqueue(batch, purpose)
            self._wake()

    def report_objects(self, report: ObjectReport) -> None:
        """Send the agent's task and objects with the next round; a newer report replaces one that waits."""
        self._report = report
        self._wake()

    def report_localisation(self, localisation: str) -> None:
        """Tell the server now, if there is a session, whether the robot is "tracked", "doubtful" or "lost"."""
        if localisation != self._localisation:
            self._localisation = localisation
            self._next_check_s = math.inf if self._session is None else 0.0
            self._wake()

    def enqueue_keyframe(self, keyframe: SpooledKeyframe, replaced: int | None = None) -> None:
        """Queue a selected keyframe; replaced: index of the one that it replaces. Raises StorageError."""
        self.spool.enqueue_keyframe(keyframe, replaced)
        self._wake()

    def drain(self, timeout_s: float) -> bool:
        """Send everything pending, also small changes. True if the server has it all, False after the timeout."""
        with self._changed:
            deadline_s = time.monotonic() + timeout_s
            self._draining = True
            self._next_round_s = 0.0
            self._changed.notify_all()
            try:
                # the limit may change during the wait
                while self._has_pending() and not (self._closing or self._stopped_because):
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
                self._sender.counters,
                voxels_waiting=self.spool.pending_voxels,
                keyframes_sent=len(self._sent_keyframes),
                keyframes_waiting=self.spool.pending_keyframes,
                keyframe_bytes=self._keyframe_bytes,
                joins=self._joins,
                connected=self._connected,
                stopped_because=self._stopped_because,
            )

    def limit_drain(self, timeout_s: float) -> None:
        """Make the current and all later calls of `drain` return by then; sending continues until `close`."""
        self._drain_limit_s = time.monotonic() + timeout_s
        self._wake()

    def close(self) -> None:
        """Leave the session, end the thread and the connection; pending updates stay in the spool."""
        self._closing = True
        self._wake()
        self._thread.join(_LEAVE_S)
        # cancels a call in flight, so that the thread does not block on the network
        self.client.close()
        self._thread.join()
        self.spool.close()

    def _wake(self) -> None:
        """Let the thread and `drain` look again at what has changed."""
        with self._changed:
            self._changed.notify_all()

    def _has_pending(self) -> bool:
        return self._has_report or self.spool.pending_voxels + self.spool.pending_keyframes > 0

    def _run(self) -> None:
        try:
            while self._wait_until_due():
                try:
                    self._end_round(self._send_round())
                except (errors.MismatchError, errors.NotPermittedError, errors.InvalidInputError) as error:
                    self._stop(str(error))
                except errors.GaussLiteError as error:
                    if not self._closing:
                        self._recover(error)
            if self._session is not None and not self._last_error:
                # ends the lease, so that a robot without its spool can take the name again at once
                self.client.leave(self._session.session_id)
        except Exception as error:
            # `close` makes a call in flight fail
            if not self._closing:
                # the operator must see that nothing is sent any more
                _log.exception("uplink failed")
                self._stop(f"{type(error).__name__}: {error}")

    def _wait_until_due(self) -> bool:
        """Wait for updates, bandwidth and the next round's time; False if the uplink ends."""
        with self._changed:
            while not self._closing and not self._stopped_because:
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
        # at the end, the last state of each voxel counts
        resend_threshold = 0.0 if self._draining else self._settings.resend_threshold
        max_bytes = self._token_bucket.available_bytes(self._settings.round_bytes)
        due = self.spool.next_round(max_bytes, resend_threshold)
        if due is None and not self._has_report:
            return False
        is_new_session = self._session is None
        session = self._join_if_needed()
        if is_new_session:
            # the comparison of digests may have added updates
            due = self.spool.next_round(max_bytes, resend_threshold)
        self._send_report(session)  # small, and the team finds objects by it: before the voxels
        if due is None:
            return True
        if due.voxels is not None:
            messages = self._sender.encode(due.voxels, session)
            # before sending: a lost message has used the band too
            self._token_bucket.spend(sum(len(part.request.subset) for part in messages.values()))
            self._sender.send(messages)
        if due.keyframes:
            self._send_keyframes(due.keyframes, session)
        return True

    def _check_server(self) -> None:
        """Ask the server whether it has every acknowledged update; if not, join again and send what it lacks."""
        if self._session is None:
            # the server did not know the session
            self._join_if_needed()
            return
        kept = self.client.keep_session(self._session.session_id, self._localisation)
        self._next_check_s = time.monotonic() + self._settings.check_interval_s
        if kept.alignment.message != self._frame_message:
            self._frame_message = kept.alignment.message
            _log.warning("uplink: %s", self._frame_message or "frame: nothing contradicts it any more")
        if not self.spool.is_stored_by(kept.incarnation_id, kept.highest_update_seq):
            self._forget_session()
            self._join_if_needed()

    def _forget_session(self) -> None:
        """Join again with the next round, and send objects again; digests find the other updates."""
        self._session = None
        self._sent_report = None

    def _resend_missing(self, session: Session) -> None:
        """If the server may have lost updates, compare digests and mark as unsent what differs."""
        if self.spool.is_stored_by(session.incarnation_id, session.highest_update_seq):
            return
        acknowledged = self.spool.acknowledged_digests()  # digests of tiles: a few bytes in place of the map
        stored = self.client.stored_digests(session.session_id) if len(acknowledged.tiles) else acknowledged
        resent = self.spool.begin_sending_to(
            session.incarnation_id, session.highest_update_seq, acknowledged.differing(stored)
        )
        if len(acknowledged.tiles):
            _log.warning("uplink: %s lacks some of what it had; %d voxels are sent again", self.client, resent)

    @property
    def _has_report(self) -> bool:
        return self._report != self._sent_report

    def _send_report(self, session: Session) -> None:
        """Send the report of objects if the server does not have it; a rejected one is dropped."""
        report = self._report
        if report is None or report == self._sent_report:
            return
        try:
            self._token_bucket.spend(self.client.report_objects(session.session_id, report))
        except errors.InvalidInputError as error:
            # the map does not depend on it
            _log.warning("uplink: the report of objects is dropped: %s", error)
        self._sent_report = report

    def _send_keyframes(self, due: Sequence[SpooledKeyframe], session: Session) -> None:
        """Send keyframes on one stream. A rejected keyframe is dropped, because it would be rejected again."""
        byte_count = sum(len(keyframe.data) for keyframe in due)
        self._token_bucket.spend(byte_count)
        messages = [geometry_pb2.EncodedFrame.FromString(keyframe.data) for keyframe in due]
        selected = self.spool.keyframe_indices()
        deadline_s = self._settings.deadline_s
        response = self.client.contribute_encoded_keyframes(session.session_id, messages, selected, deadline_s)
        self.spool.mark_keyframes_done(due)
        for rejection in response.rejected:
            _log.warning("uplink: keyframe %d is dropped: %s", rejection.index, rejection.reason)
        rejected = {rejection.index for rejection in response.rejected}
        with self._changed:
            self._sent_keyframes |= {keyframe.frame_index for keyframe in due} - rejected
            self._keyframe_bytes += byte_count

    def _join_if_needed(self) -> Session:
        if self._session is None:
            # a robot with a new map cannot send tombstones for the updates of its earlier map
            fresh = self.spool.is_new and not self._has_restored_map and self._joins == 0
            report, frame = self._report, self._settings.world_frame
            task = None if report is None else report.graph
            session = self.client.join(self.agent_id, self._grid, frame, fresh, task, self._settings.declared_frame)
            self._resend_missing(session)
            self._session = session
            self.spool.mark_keyframes_missing(session.keyframes)
            self._sender.begin_session(session.max_subset_bytes)
            self._next_check_s = time.monotonic() + self._settings.check_interval_s
            with self._changed:
                self._connected, self._joins = True, self._joins + 1
        return self._session

    def _recover(self, error: errors.GaussLiteError) -> None:
        """Prepare a retry: join again, send smaller messages, or only wait."""
        if str(error) != self._last_error:
            # logged once and not at every retry, because a robot may be offline for hours
            _log.warning("uplink: %s; retrying", error)
            self._last_error = str(error)
        if isinstance(error, errors.NameInUseError):  # its lease may end: ask again
            self._session = None
        if isinstance(error, errors.SessionUnknownError):
            self._forget_session()
        if isinstance(error, (errors.QuotaError, errors.StorageError)):
            self._sender.halve_messages()  # a smaller one may fit what is left
        with self._changed:
            self._connected = False
            self._next_round_s = time.monotonic() + self._retry_delay.after(error)

    def _end_round(self, sent: bool) -> None:
        if sent and self._last_error:
            _log.info("uplink: %s accepts updates again", self.client)
            self._last_error = ""
        with self._changed:
            self._retry_delay.reset()
            self._connected = self._session is not None
            if not (sent and self._draining):
                self._next_round_s = time.monotonic() + max(self._settings.interval_s, _MIN_INTERVAL_S)
            self._changed.notify_all()

    def _stop(self, reason: str) -> None:
        _log.error("uplink stopped: %s", reason)
        self._connected, self._stopped_because = False, reason
        self._wake()
