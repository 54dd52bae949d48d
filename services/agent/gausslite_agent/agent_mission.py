"""Run one mission of the agent: map its source, send the rest to the fusion server, write the results."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future
from enum import Enum

from gausslite.domain.errors import GaussLiteError, StorageError
from gausslite.domain.frame import Frame
from gausslite.mission.checkpoint import ResumeConfig
from gausslite.mission.frame_stream import CorruptFrames, FrameStream
from gausslite.mission.results import write_results
from gausslite.mission.runner import MissionRunner
from gausslite.task.parser import TaskParser
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose
from gausslite.wire.uplink import Uplink
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission_checkpoint import MissionCheckpoint
from gausslite_agent.report import mission_report
from gausslite_agent.settings import AgentSettings
from gausslite_agent.status import FrameReport

_log = logging.getLogger(__name__)


class MissionState(Enum):
    """Phase of a mission."""

    IDLE = "idle"
    MAPPING = "mapping"
    DRAINING = "draining"
    DONE = "done"


class AgentMission:
    """One mission. Its methods block: call them on a thread. `stop` may be called on any thread."""

    def __init__(
        self,
        settings: AgentSettings,
        worker: MappingWorker,
        parser: TaskParser,
        client: FusionClient | None,
        resumed: MissionCheckpoint | None = None,
    ) -> None:
        """Resumed: the checkpoint that the worker was restored from."""
        self._settings, self._worker, self._parser, self._client = settings, worker, parser, client
        self._resumed = resumed
        self._stopping = threading.Event()
        self._state = MissionState.IDLE
        self._start_s = time.monotonic()
        self._corrupt = CorruptFrames(_log.warning)
        self._pending: Future[FrameReport] | None = None

    @property
    def state(self) -> MissionState:
        """The phase of the mission; an agent without a source is mapping as soon as it has a task."""
        if self._state is MissionState.IDLE and self._worker.status().graph is not None:
            return MissionState.MAPPING
        return self._state

    def stop(self) -> None:
        """End the mission after the current frame. The results are written, but nothing more is sent."""
        self._stopping.set()

    def assign_task(self) -> None:
        """Assign the task of the command line.

        A resumed mission that was started with the same command-line task keeps its current task. Raises TaskError,
        UnavailableError, ModelFileError.
        """
        resumed, task = self._resumed, self._settings.task
        if resumed is not None:
            _log.info("resuming %r after frame %d", resumed.graph.text, resumed.last_index)
        if task is not None and (resumed is None or task != resumed.requested_task):
            self._worker.assign(self._parser.parse(task)).result()

    def run(self, stream: FrameStream) -> None:
        """Assign the task, map every frame and finish. Raises the errors of the source, the disk and the task.

        An error after the first mapped frame ends the mission early: the map so far is sent and written first.
        """
        self._start_s = time.monotonic()
        self.assign_task()
        self._state = MissionState.MAPPING
        failure = self._map_all(stream)
        if failure is None and self._worker.status().mapped == 0:
            failure = self._corrupt.first_error
        if failure is None:
            self._finish()
            return
        if self._worker.status().mapped > 0:
            self._finish(str(failure))
        raise failure

    def finish(self) -> None:
        """End a mission whose frames came by IngestFrames: write the map if there is one. Raises StorageError."""
        if self._worker.status().mapped > 0:
            self._finish()
        elif self._resumed is not None:
            # the task may have changed
            self._save()

    def _map_all(self, stream: FrameStream) -> GaussLiteError | None:
        """Map the frames of the stream, and return the error that ended it early."""
        last_index = -1 if self._resumed is None else self._resumed.last_index
        frames = stream.after(last_index).frames(None if self._settings.strict else self._corrupt)
        result = MissionRunner(self._submit, should_stop=self._stopping.is_set).run(frames, last_index)
        try:
            self._wait_for_pending()
        except GaussLiteError as error:
            return error
        return result.stopped_by if isinstance(result.stopped_by, GaussLiteError) else None

    def _submit(self, frame: Frame) -> None:
        """Wait for the frame before, then queue this one, so that one frame is read while another is mapped."""
        self._wait_for_pending()
        if not self._stopping.is_set():
            self._pending = self._worker.submit(frame)

    def _wait_for_pending(self) -> None:
        pending, self._pending = self._pending, None
        if pending is None:
            return
        report = pending.result()
        if report.reason:
            _log.info("frame %d %s: %s", report.index, report.outcome.value, report.reason)

    def _finish(self, ended_by: str | None = None) -> None:
        """Save the mission, send what waits and write the results; ended_by: the error that ended it early."""
        self._state = MissionState.DRAINING
        self._worker.end_idle_training().result()
        # first, because sending and writing can take minutes that a robot may not have
        self._save()
        uplink, counters = self._worker.uplink, UplinkCounters()
        if uplink is not None:
            if not self._stopping.is_set():
                self._send_all(uplink)
            counters = uplink.counters()
        stopped_by = "interrupted" if self._stopping.is_set() else ended_by
        gaussians = self._write_results(counters, stopped_by)
        status = self._worker.status()
        _log.info(
            "mission %s: %d frames at %.2f Hz, %d Gaussians, %d bytes of the task's region sent",
            "interrupted" if self._stopping.is_set() else "ended early" if ended_by else "done",
            *(status.mapped, status.hz, gaussians, counters.roi_bytes),
        )
        if not self._stopping.is_set():
            self._state = MissionState.DONE

    def _save(self) -> None:
        settings = self._settings
        if settings.state is not None:
            config = ResumeConfig.of(*settings.fixed_settings)
            self._worker.save(settings.state, config, settings.task or "").result()

    def _write_results(self, counters: UplinkCounters, stopped_by: str | None) -> int:
        """Write the map and the report if there is a folder for them, and return the number of Gaussians."""
        gaussians = self._worker.run(lambda mapper: mapper.gaussians()).result()
        if self._settings.out is not None:
            seconds = time.monotonic() - self._start_s
            report = {
                **mission_report(self._settings.agent_id, self._worker.status(), gaussians, counters, seconds),
                "frames_corrupt": self._corrupt.count,
                "memory_mib": self._worker.run(lambda mapper: mapper.memory_mib()).result(),
                "stopped_by": stopped_by,
                "resumed_after_frame": None if self._resumed is None else self._resumed.last_index,
            }
            write_results(self._settings.out, gaussians, report, self._settings.link.uplink.world_frame)
        return len(gaussians)

    def _send_all(self, uplink: Uplink) -> None:
        """Send the rest of the region and, with --handover, the rest of the map and the keyframes."""
        link = self._settings.link
        drained = uplink.drain(link.drain_s)
        if link.handover and drained:
            try:
                uplink.enqueue(self._worker.handover_batch().result(), Purpose.HANDOVER)
            except StorageError as error:
                _log.warning("handover: %s", error)
            else:
                drained = uplink.drain(link.drain_s)
                self._send_keyframes(uplink)
        if not drained:
            consequence = (
                "they are lost when this process ends"
                if link.spool is None
                else f"they stay in {link.spool} until the agent is started again"
            )
            _log.warning("uplink: %d voxels are not sent; %s", uplink.counters().voxels_waiting, consequence)

    def _send_keyframes(self, uplink: Uplink) -> None:
        assert self._client is not None
        keyframes = self._worker.run(lambda mapper: mapper.keyframes()).result()
        try:
            accepted = self._client.contribute_keyframes(uplink.session_id, [each.frame for each in keyframes])
        except GaussLiteError as error:
            # the map is complete without them; they only improve its refinement
            _log.warning("keyframes: %s", error)
        else:
            _log.info("handed over %d of %d keyframes", accepted, len(keyframes))
