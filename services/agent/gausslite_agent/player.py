"""Play a sequence as the robot's camera, and end the mission: empty the uplink, hand over, write the results."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from enum import Enum

from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.errors import GaussLiteError
from gausslite.evaluation.held_out import HoldOut
from gausslite.mission.results import write_results
from gausslite.task.parser import TaskParser
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose
from gausslite.wire.uplink import Uplink
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.report import mission_report
from gausslite_agent.robot import FrameReport, Robot
from gausslite_agent.settings import AgentSettings, PlaySettings

_log = logging.getLogger(__name__)


class MissionState(Enum):
    """Where a mission is."""

    IDLE = "idle"
    MAPPING = "mapping"
    DRAINING = "draining"
    DONE = "done"


class Player:
    """Runs one mission from a source. `play` blocks: call it on a thread; `stop` makes it end after its frame."""

    def __init__(self, settings: AgentSettings, robot: Robot, parser: TaskParser, client: FusionClient | None) -> None:
        self._settings, self._robot, self._parser, self._client = settings, robot, parser, client
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

    def assign(self) -> None:
        """Give the robot the task of the command line."""
        self._robot.assign(self._parser.parse(self._settings.task or "")).result()

    def play(self, source: Source, play: PlaySettings) -> None:
        """Map every frame, then end the mission. Raises what the source, the disk or the task raise."""
        self._started_s = time.monotonic()
        frames = _frames(source, play)
        self.assign()
        self._state = MissionState.MAPPING
        waiting: Future[FrameReport] | None = None
        for frame in frames:
            # one frame is read while the one before is mapped
            if waiting is not None:
                self._note(waiting.result())
            if self._stopping.is_set():
                break
            waiting = self._robot.submit(frame)
        if waiting is not None:
            waiting.result()
        self._finish()

    def conclude(self) -> None:
        """End a mission whose frames were sent: write what is mapped, if anything is. Raises StorageError."""
        if self._robot.status().mapped > 0:
            self._finish()

    def _finish(self) -> None:
        self._state = MissionState.DRAINING
        self._robot.settle().result()
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
            write_results(self._settings.out, gaussians, {**report, "memory_mib": memory_mib})
        _log.info(
            "mission %s: %d frames at %.2f Hz, %d Gaussians, %d bytes of the task's region sent",
            "interrupted" if self._stopping.is_set() else "done",
            *(status.mapped, status.hz, len(gaussians), counters.roi_bytes),
        )
        if not self._stopping.is_set():
            self._state = MissionState.DONE

    def _empty(self, uplink: Uplink) -> None:
        """Bring the rest to the server: the region, then (when asked) everything else and the keyframes."""
        link = self._settings.link
        drained = uplink.drain(link.drain_s)
        if link.handover and drained:
            uplink.offer(self._robot.handover_words().result(), Purpose.HANDOVER)
            drained = uplink.drain(link.drain_s)
            self._contribute_keyframes(uplink)
        if not drained:
            _log.warning("uplink: not everything arrived: %s", uplink.counters())

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


def _frames(source: Source, play: PlaySettings) -> Iterator[Frame]:
    """The chosen frames, read as they are asked for; wrong choices are raised at once."""
    size = frame_size(play.size, source)
    positions: Sequence[int] = select_frames(source, play.frames)
    if play.hold_out is not None:
        positions, _ = HoldOut(play.hold_out).split(positions)
    return (source.frame(position, size) for position in positions)
