"""Run one mission of the agent: map its frames, send the rest to the fusion server, write and summarise the results."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from gausslite.codec.json import graph_as_json, noun_as_json, object_as_json
from gausslite.domain.errors import GaussLiteError, InvalidInputError, MismatchError, StorageError
from gausslite.domain.frame import ClockJumps, Frame
from gausslite.domain.objects import match_warnings
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.checkpoint import ResumeConfig
from gausslite.mission.prior_map import compare_with_prior
from gausslite.mission.results import peak_rss_mib, write_keyframes, write_poses, write_results
from gausslite.mission.runner import CorruptFrames, FrameStream, MissionRunner
from gausslite.wire.convert import values_of
from gausslite.wire.convert_task import AssignedTask
from gausslite.wire.spool import Purpose
from gausslite.wire.update_sender import UplinkCounters
from gausslite.wire.uplink import Uplink
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.settings import AgentSettings
from gausslite_agent.state import (
    EndRequest,
    FrameReport,
    MissionCheckpoint,
    MissionState,
    MissionStateMachine,
    MissionSummary,
    WorkerStatus,
)

_REPORTED_UPLINK_COUNTERS = (
    *("handover_bytes", "keyframe_bytes", "keyframes_sent", "keyframes_waiting", "gaussians_sent"),
    *("voxels_sent", "subsets_sent", "subsets_rejected", "voxels_waiting"),
)
_log = logging.getLogger(__name__)
_INTERRUPTED = "interrupted"
_BEFORE_ALL_NS = -1
NO_DETECTOR = (
    "this agent cannot find the objects of a task, because it has no detector; start it with --detector FILE.onnx"
)


def mission_report(
    agent_id: str, status: WorkerStatus, gaussians: int, active: int, uplink: UplinkCounters, seconds: float
) -> dict[str, object]:
    """Return the figures of a mission. map_shared_percent: of the Gaussians in the region; 0 if no update was sent."""
    graph = status.graph
    is_sent = uplink.subsets_sent > 0
    return {
        "agent_id": agent_id,
        "task": "" if graph is None else graph.text,
        "localisation": status.localisation.name.lower(),
        "targets": [] if graph is None else list(graph.targets),
        "task_graph": None if graph is None else graph_as_json(graph),
        "frames": status.mapped,
        **{f"frames_{outcome}": getattr(status, outcome) for outcome in ("skipped", "dropped", "rejected")},
        "frames_under_trained": status.under_trained,
        "frames_not_published": status.publishing_skipped,
        "frames_without_seeding": status.seeding_skipped,
        **values_of(status, ("iterations", "idle_iterations")),
        "max_detection_lag_frames": status.max_detection_lag,
        "keyframes_reevaluated": status.keyframes_reevaluated,
        "hz": status.hz,
        "frame_age_p50_s": status.age_s(50),
        "frame_age_p99_s": status.age_s(99),
        "seconds": seconds,
        "gaussians": gaussians,
        "active_gaussians": active,
        "roi_share": status.roi_share,
        "bytes_sent": uplink.roi_bytes,
        **values_of(uplink, _REPORTED_UPLINK_COUNTERS),
        "uplink_stopped_because": uplink.stopped_because,
        "map_shared_percent": 100.0 * active / max(gaussians, 1) if is_sent else 0.0,
        "peak_rss_mib": peak_rss_mib(),
        "team_gaussians_inserted": status.team_gaussians,
        "nouns": [noun_as_json(noun) for noun in status.nouns],
        "notes": [*status.notes, *status.task_notes, *status.load_notes],
    }


class AgentMission:
    """One mission after another, with one map. Its methods block and are thread-safe: call them on a thread."""

    def __init__(
        self,
        settings: AgentSettings,
        worker: MappingWorker,
        parser: TaskParser,
        resumed: MissionCheckpoint | None = None,
        can_find: bool = True,
        source_notes: tuple[str, ...] = (),
    ) -> None:
        """Wait for a task. resumed: the checkpoint that the worker was restored from.

        can_find: False if any task would fail. source_notes: messages on the recording.
        """
        self.can_find, self._source_notes, self._save_failure, self._last_reason = can_find, source_notes, "", ""
        self._settings, self._worker, self._parser, self._resumed = settings, worker, parser, resumed
        self._up_axis = settings.up_axis or (0.0, 0.0, 1.0)
        self._state_machine = MissionStateMachine()
        self._start_s = time.monotonic()
        self._corrupt = CorruptFrames(_log.warning)
        self._clock, self._latest_ns = ClockJumps(), _BEFORE_ALL_NS
        self._pending: Future[FrameReport] | None = None
        # set while no source is mapped
        self._replay_ended = threading.Event()
        self._replay_ended.set()
        self._stopping, self._was_stopped = threading.Event(), False
        self._ending = threading.Lock()
        # the first request to end this mission; it counts also if the thread that maps the source ends the mission
        self._requested: EndRequest | None = None
        self._summary: MissionSummary | None = None

    @property
    def state(self) -> MissionState:
        """The state of the mission."""
        return self._state_machine.state

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator about the mission itself."""
        failure = self._state_machine.failure
        failed = f"the mission failed: {failure}" if failure else ""
        blind = "" if self.can_find else NO_DETECTOR
        return tuple(filter(None, (failed, self._save_failure, *self._source_notes, blind)))

    @property
    def end_by_options(self) -> EndRequest:
        """How the mission ends without a request: by the options of the command line."""
        return EndRequest(self._settings.link.handover, self._settings.link.drain_s)

    def stop(self, grace_s: float = 0.0) -> None:
        """End the mission after the current frame; sending ends after `grace_s` seconds, also if it has begun."""
        self._was_stopped = True
        self._stopping.set()
        if self._worker.uplink is not None:
            self._worker.uplink.limit_drain(grace_s)

    def assign(self, assigned: AssignedTask) -> TaskGraph:
        """Assign a task, which begins the next mission if the last one has ended; return it with further warnings.

        The warnings name the nouns that the detector cannot find, with the nearest names that it can. Without a
        detector, a person must point at all targets. Raises MismatchError while a mission ends, InvalidInputError,
        ModelFileError and the like.
        """
        self._state_machine.require_accepting("task")
        if not self.can_find and assigned.graph is not None and assigned.graph.queries:
            raise MismatchError(f"task: {NO_DETECTOR}")
        graph = self._worker.assign(assigned.graph, assigned.pointed, assigned.excluded_m).result()
        self._begin()
        return graph.with_warnings(match_warnings([noun.match for noun in self._worker.status().nouns]))

    def assign_task(self) -> None:
        """Assign the task of the command line.

        A resumed mission that was started with the same command-line task keeps its current task. Raises TaskError,
        UnavailableError, ModelFileError.
        """
        resumed, task = self._resumed, self._settings.task
        if resumed is not None:
            _log.info("resuming %r after frame %d", resumed.graph.text, resumed.last_index)
            self._begin()
        if task is not None and (resumed is None or task != resumed.requested_task):
            self.assign(AssignedTask(self._parser.parse(task)))

    def submit(self, frame: Frame) -> Future[FrameReport]:
        """Queue a frame and return the future of its report. Call it from one thread.

        Raises MismatchError unless the mission is mapping, InvalidInputError for a frame that is not later than the one
        before, unless the clock has jumped.
        """
        self._state_machine.require_mapping()
        self._require_later(frame.capture_time_ns)
        return self._worker.submit(frame)

    def run(self, stream: FrameStream) -> None:
        """Assign the task, map every frame and end the mission. Raises the errors of the source, the disk and the task.

        An error after the first mapped frame ends the mission early: the map so far is sent and written first.
        """
        self._start_s, self._up_axis = time.monotonic(), stream.source.up_axis
        self._replay_ended.clear()
        try:
            self.assign_task()
            failure = self._replay(stream)
        except GaussLiteError as error:
            self._state_machine.enter(MissionState.FAILED, str(error))
            raise
        finally:
            self._replay_ended.set()
        if failure is None and self._worker.status().mapped == 0:
            failure = self._corrupt.first_error
        if failure is None or self._worker.status().mapped > 0:
            self._end(self.end_by_options, None if failure is None else str(failure))
        if failure is not None:
            raise failure

    def end(self, request: EndRequest) -> MissionSummary:
        """End the mission and return what was sent and left. A later call waits and returns the same.

        The first request counts; without one, the options of the command line.

        Raises MismatchError before the first task, StorageError if the results cannot be written; the mission is FAILED
        then and can be ended again.
        """
        if self.state is MissionState.WAITING_FOR_TASK:
            raise MismatchError("mission: expected a task first, got none yet; call AssignTask")
        if self._summary is None:
            self._requested = self._requested or request
            self._stopping.set()
        self._replay_ended.wait()
        return self._end(request, None)

    def finish(self) -> None:
        """End the mission because the process ends; one without a task has nothing to send or write."""
        self._stopping.set()
        self._replay_ended.wait()
        if self.state is not MissionState.WAITING_FOR_TASK:
            self._end(self.end_by_options, None)

    def describe_lost_data(self) -> str:
        """Return what is lost when the process ends now, because no file keeps it; empty if nothing is."""
        uplink = self._worker.uplink
        if uplink is None or self._settings.link.spool is not None:
            return ""
        left = uplink.counters()
        if not (left.voxels_waiting or left.keyframes_waiting):
            return ""
        return (
            f"lost {left.voxels_waiting} voxels and {left.keyframes_waiting} keyframes that were not sent; "
            "--set spool=FILE keeps them until the next start"
        )

    def save(self) -> float:
        """Save the mission after the current frame, if to a file; returns the seconds taken. Raises StorageError."""
        settings = self._settings
        if settings.state is None:
            return 0.0
        config = ResumeConfig.of(*settings.fixed_settings)
        return self._worker.save(settings.state, config, settings.task or "").result()

    def save_if_mapping(self) -> float:
        """Do the same, unless the mission is not mapping now; a failure is noted until a save succeeds."""
        try:
            took_s, failure = self.save() if self.state is MissionState.MAPPING else 0.0, ""
        except GaussLiteError as error:
            took_s, failure = 0.0, f"the mission is not saved: {error}"
            if not self._save_failure:
                _log.warning("%s", failure)
        self._save_failure = failure
        return took_s

    def _require_later(self, time_ns: int) -> None:
        latest_ns = self._latest_ns
        if self._clock.has_jumped(time_ns, latest_ns):
            back_s = (latest_ns - time_ns) / 1e9
            _log.warning("the frames' capture times went back by %.3f s: their clock was set, or began again", back_s)
        elif time_ns <= latest_ns:
            raise InvalidInputError(
                f"frame capture_time_ns: expected more than {latest_ns}, that of the frame before, got {time_ns}"
            )
        self._latest_ns = time_ns

    def _begin(self) -> None:
        if self.state is not MissionState.MAPPING:
            self._summary = self._requested = None
            self._latest_ns = _BEFORE_ALL_NS
            self._state_machine.enter(MissionState.MAPPING)

    def _replay(self, stream: FrameStream) -> GaussLiteError | None:
        """Map the frames of the stream, and return the error that ended it early."""
        try:
            last_index = -1 if self._resumed is None else self._resumed.last_index
            frames = stream.after(last_index).frames(None if self._settings.strict else self._corrupt)
            result = MissionRunner(self._submit, should_stop=self._stopping.is_set).run(frames, last_index)
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
        if report.reason not in ("", self._last_reason, *self._worker.status().notes):
            _log.info("frame %d %s: %s", report.index, report.outcome.value, report.reason)
        self._last_reason = report.reason

    def _end(self, request: EndRequest, ended_by: str | None) -> MissionSummary:
        """End the mission once, by `end`'s request if there is one; ended_by: the error that ended it early."""
        with self._ending:
            if self._summary is not None:
                return self._summary
            # from here on frames are refused; those in the queue are still mapped
            self._state_machine.enter(MissionState.DRAINING)
            request, self._requested = self._requested or request, None
            try:
                summary = self._send_and_write(request, ended_by)
            except GaussLiteError as error:
                self._state_machine.enter(MissionState.FAILED, str(error))
                raise
            _log.log(logging.INFO if summary.is_complete else logging.WARNING, "%s", summary.line())
            self._stopping.clear()
            self._summary = summary
            self._state_machine.enter(MissionState.ENDED)
            return summary

    def _send_and_write(self, request: EndRequest, ended_by: str | None) -> MissionSummary:
        self._worker.end_idle_training().result()
        # first, because sending and writing can take minutes that a robot may not have
        self.save()
        if self._worker.uplink is not None:
            self._send_all(self._worker.uplink, request)
        if self._stopping.is_set() and (self._settings.source is not None or self._was_stopped):
            ended_by = ended_by or _INTERRUPTED
        gaussians = self._worker.run(lambda mapper: mapper.count).result()
        status, uplink = self._worker.status(), self._worker.uplink
        for note in (*status.noun_notes, *status.task_notes):
            _log.log(logging.INFO if note in status.noun_notes else logging.WARNING, "%s", note)
        counters = None if uplink is None else uplink.counters()
        if self._settings.out is not None and status.mapped > 0:
            self._write_results(self._settings.out, counters or UplinkCounters(), ended_by)
        spool = self._settings.link.spool
        return MissionSummary(status.mapped, status.hz, gaussians, ended_by, counters, spool)

    def _write_results(self, folder: Path, counters: UplinkCounters, ended_by: str | None) -> None:
        seconds, status = time.monotonic() - self._start_s, self._worker.status()
        sizes = self._worker.run(lambda mapper: (mapper.count, len(mapper.gaussians(active_only=True)))).result()
        report: dict[str, Any] = {
            **mission_report(self._settings.agent_id, status, *sizes, counters, seconds),
            "up": list(self._up_axis),
            "frames_corrupt": self._corrupt.count,
            "memory_mib": self._worker.run(lambda mapper: mapper.memory_mib()).result(),
            "stopped_by": ended_by,
            "resumed_after_frame": None if self._resumed is None else self._resumed.last_index,
        }
        report["notes"] = [*self._source_notes, *report["notes"]]
        prior = self._worker.prior
        keyframes = self._worker.run(lambda mapper: mapper.store.kept).result()
        changes = compare_with_prior(
            prior, lambda: self._worker.run(GaussianMapper.gaussians).result(), status.found, keyframes
        )
        for line in changes.lines:
            _log.info("since the earlier map: %s", line)
        report |= {**changes.report, "objects": [object_as_json(landmark) for landmark in changes.objects]}
        world_frame = self._settings.link.uplink.world_frame or ("" if prior is None else prior.world_frame)
        self._worker.run(lambda own: write_results(folder, own.count, own.parts(), report, world_frame)).result()
        motion = None if prior is None else prior.motion
        self._worker.run(lambda mapper: write_poses(folder, mapper.poses, motion)).result()
        write_keyframes(folder, keyframes)
        self._worker.write_records(folder, keyframes).result()

    def _send_all(self, uplink: Uplink, request: EndRequest) -> None:
        """Send the rest of the region and the keyframes and, for a handover, the rest of the map, within one time."""
        deadline_s = time.monotonic() + request.drain_s
        drained = uplink.drain(request.drain_s)
        # without a file, more data would only delay the region's, and would be lost
        if not request.handover or not (drained or self._settings.link.spool):
            return
        self._state_machine.enter(MissionState.HANDING_OVER)
        try:
            self._worker.select_keyframes().result()
            uplink.enqueue(self._worker.handover_batch().result(), Purpose.HANDOVER)
        except StorageError as error:
            _log.warning("handover: %s", error)
        uplink.drain(deadline_s - time.monotonic())
