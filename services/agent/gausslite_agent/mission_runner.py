"""Play a sequence as the robot's camera, and end the mission: empty the uplink, hand over, write the results."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future
from enum import Enum

from gausslite.errors import GaussLiteError, StorageError
from gausslite.mission.results import write_results
from gausslite.task.parser import TaskParser
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose
from gausslite.wire.uplink import Uplink
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission_checkpoint import MissionCheckpoint
from gausslite_agent.replay_source import ReplaySource
from gausslite_agent.report import mission_report
from gausslite_agent.settings import AgentSettings
from gausslite_agent.status import FrameReport

_log = logging.getLogger(__name__)


class MissionState(Enum):
    """Where a mission is."""

    IDLE = "idle"
    MAPPING = "mapping"
    DRAINING = "draining"
    DONE = "done"


class AgentMission:
    """Runs one mission from a source. `play` blocks: call it on a thread; `stop` makes it end after its frame."""

    def __init__(
        self,
        settings: AgentSettings,
        robot: MappingWorker,
        parser: TaskParser,
        client: FusionClient | None,
        earlier: MissionCheckpoint | None = None,
    ) -> None:
        """With `earlier` the robot has taken up a saved mission, and the player goes on with it."""
        self._settings, self._robot, self._parser, self._client = settings, robot, parser, client
        self._earlier = earlier
        self._stopping = threading.Event()
        self._state = MissionState.IDLE
        self._started_s = time.monotonic()

    @property
    def state(self) -> MissionState:
        """Where the mission is; a robot that is sent frames maps as soon as it has a task."""
        if self._state is MissionState.IDLE and self._robot.status().graph is not None:
            return MissionState.MAPPING
        return self._state

    def stop(self) -> None:
        """End the mission early: what is mapped is written, nothing more is sent."""
        self._stopping.set()

    def begin(self) -> None:
        """Give the robot the task of the command line, unless its saved mission was begun with it.

        So a task that came on the way stays in force. Raises TaskError, ModelFileError and the like.
        """
        earlier, asked = self._earlier, self._settings.task
        if earlier is not None:
            _log.info("goes on with %r after frame %d", earlier.graph.text, earlier.last_index)
        if asked is not None and (earlier is None or asked != earlier.asked):
            self._robot.assign(self._parser.parse(asked)).result()

    def play(self, stand_in: ReplaySource) -> None:
        """Map every frame, then end the mission. Raises what the source, the disk or the task raise.

        Such an error ends the mission early: what was mapped until then is sent and written, then it is raised.
        """
        self._started_s = time.monotonic()
        self.begin()
        self._state = MissionState.MAPPING
        last_index = -1 if self._earlier is None else self._earlier.last_index
        failure: GaussLiteError | None = None
        waiting: Future[FrameReport] | None = None
        try:
            for frame in stand_in.frames(last_index):
                # one frame is read while the one before is mapped
                if waiting is not None:
                    self._note(waiting.result())
                if self._stopping.is_set():
                    break
                waiting = self._robot.submit(frame)
            if waiting is not None:
                waiting.result()
        except GaussLiteError as error:
            failure = error
        if failure is None:
            self._finish()
            return
        if self._robot.status().mapped > 0:
            self._finish(str(failure))
        raise failure

    def conclude(self) -> None:
        """End a mission whose frames were sent: write what is mapped, if anything is. Raises StorageError."""
        if self._robot.status().mapped > 0:
            self._finish()
        elif self._earlier is not None:
            # there may be another task than before
            self._save()

    def _finish(self, ended_by: str | None = None) -> None:
        """Save, send what waits and write the results; ended_by says what kept the mission from its last frame."""
        self._state = MissionState.DRAINING
        self._robot.settle().result()
        self._save()
        gaussians = self._robot.do(lambda mapper: mapper.gaussians()).result()
        uplink, counters = self._robot.uplink, UplinkCounters()
        if uplink is not None:
            if not self._stopping.is_set():
                self._empty(uplink)
            counters = uplink.counters()
        status = self._robot.status()
        if self._settings.out is not None:
            seconds = time.monotonic() - self._started_s
            report = mission_report(self._settings.agent_id, status, gaussians, counters, seconds)
            memory_mib = self._robot.do(lambda mapper: mapper.memory_mib()).result()
            stopped_by = "interrupted" if self._stopping.is_set() else ended_by
            resumed = None if self._earlier is None else self._earlier.last_index
            about = {"memory_mib": memory_mib, "stopped_by": stopped_by, "resumed_after_frame": resumed}
            write_results(self._settings.out, gaussians, {**report, **about})
        _log.info(
            "mission %s: %d frames at %.2f Hz, %d Gaussians, %d bytes of the task's region sent",
            "interrupted" if self._stopping.is_set() else "ended early" if ended_by else "done",
            *(status.mapped, status.hz, len(gaussians), counters.roi_bytes),
        )
        if not self._stopping.is_set():
            self._state = MissionState.DONE

    def _save(self) -> None:
        """First of all, since sending and drawing up results can take minutes that a robot may not have."""
        settings = self._settings
        if settings.state is not None:
            self._robot.save(settings.state, settings.terms, settings.task or "").result()

    def _empty(self, uplink: Uplink) -> None:
        """Bring the rest to the server: the region, then (when asked) everything else and the keyframes."""
        link = self._settings.link
        drained = uplink.drain(link.drain_s)
        if link.handover and drained:
            try:
                uplink.enqueue(self._robot.handover_words().result(), Purpose.HANDOVER)
            except StorageError as error:
                _log.warning("handover: %s", error)
            else:
                drained = uplink.drain(link.drain_s)
                self._contribute_keyframes(uplink)
        if not drained:
            spool = self._settings.link.spool
            kept = (
                "they are lost when this process ends" if spool is None else f"they stay in {spool} for the next life"
            )
            _log.warning("uplink: words on %d voxels wait still; %s", uplink.counters().voxels_waiting, kept)

    def _contribute_keyframes(self, uplink: Uplink) -> None:
        assert self._client is not None
        keyframes = self._robot.do(lambda mapper: mapper.keyframes()).result()
        try:
            accepted = self._client.contribute_keyframes(uplink.session_id, [k.frame for k in keyframes])
        except GaussLiteError as error:
            # the map is there without them; only its refinement is poorer
            _log.warning("keyframes: %s", error)
        else:
            _log.info("handed over %d of %d keyframes", accepted, len(keyframes))

    def _note(self, report: FrameReport) -> None:
        if report.reason:
            _log.info("frame %d %s: %s", report.index, report.outcome.value, report.reason)
