"""The agent as a process, until its mission ends or a signal ends it."""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from typing import Protocol

from gausslite.config.task_parser import DefaultParser
from gausslite.config.values import NONE
from gausslite.datasets.calibration import as_recorded_notes, open_calibrator
from gausslite.datasets.source import Source
from gausslite.domain.errors import UnavailableError
from gausslite.domain.pose import unit_up_axis
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.plan import RunPlan
from gausslite.mission.prior_map import PriorMap, open_prior_map
from gausslite.mission.results import locked_folder, prepare_file
from gausslite.mission.runner import FrameStream, ground_truth_notes
from gausslite.mission.settings import SceneInfo, SourceSettings
from gausslite.pages import load_pages
from gausslite.plugins import Group, installed, load
from gausslite.process import ROBOT_LOST, TASK_NOT_FOUND
from gausslite.wire.clients import FusionClient, ParserClient
from gausslite.wire.run_service import run_service
from gausslite.wire.server import serve_until_stopped
from gausslite.wire.spool import Spool
from gausslite.wire.uplink import Uplink
from gausslite.wire.views import ChangeNotifier
from gausslite_agent.keyframe_upload import KeyframeUpload, open_upload
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission import NO_DETECTOR, AgentMission
from gausslite_agent.servicer import AgentServicer
from gausslite_agent.settings import AgentSettings, ConnectionSettings, parse_arguments
from gausslite_agent.state import SavedMission

_log = logging.getLogger(__name__)
_TIMEOUT_S = 30.0
_RETRY_S = 0.5
_MIN_INTERVAL_PER_SAVE = 20.0
"""Saving takes at most a twentieth of the time."""


class TeamMap(Protocol):
    """Inserts what teammates trained into an agent's map, on a thread of its own."""

    def close(self) -> None:
        """End the thread and the connection."""


OpenTeamMap = Callable[[FusionClient, str, str, MappingWorker], TeamMap]
"""The default of `gausslite.team_maps`, called with an own client, the agent's id, the layer to follow, and the map."""


class WaitingParser:
    """A TaskParser that retries while its service is unavailable, up to 30 seconds."""

    def __init__(
        self, parser: TaskParser, timeout_s: float = _TIMEOUT_S, cancel: Callable[[], None] = lambda: None
    ) -> None:
        """cancel: ends the parser's open calls with UnavailableError; a service may accept a call and not answer."""
        self._parser = parser
        self._timeout_s = timeout_s
        self._cancel = cancel
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End the wait: an open call is cancelled, and `parse` raises UnavailableError with the last error before."""
        self._stopping.set()
        self._cancel()

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of a task. Raises TaskError; UnavailableError after the timeout or `stop`."""
        deadline_s = time.monotonic() + self._timeout_s
        last_error: UnavailableError | None = None
        while True:
            try:
                return self._parser.parse(text)
            except UnavailableError as error:
                if not self._stopping.is_set():
                    if time.monotonic() >= deadline_s:
                        raise
                    if last_error is None:
                        _log.warning("%s; retrying for %.0f s", error, self._timeout_s)
                    last_error = error
                # the error of a call that `stop` cancels says nothing about the service
                if self._stopping.wait(_RETRY_S):
                    waited = "stopped while waiting for the parser service"
                    raise UnavailableError(waited if last_error is None else f"{waited}: {last_error}") from None


class PeriodicSave:
    """A context that calls `save` on a thread of its own; with an interval of 0 it does nothing."""

    def __init__(self, save: Callable[[], float], interval_s: float) -> None:
        """`save` returns the seconds that it took. interval_s: between two saves; slow ones are rarer."""
        self._save, self._interval_s = save, interval_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="periodic save", daemon=True)

    def __enter__(self) -> PeriodicSave:
        if self._interval_s > 0:
            self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """End the thread without waiting for a save that has begun; the mission's own save follows it."""
        self._ended.set()

    def _run(self) -> None:
        wait_s = self._interval_s
        while not self._ended.wait(wait_s):
            wait_s = max(self._interval_s, _MIN_INTERVAL_PER_SAVE * self._save())


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the agent and return its exit code.

    1 if data that no spool keeps was not sent, 4 if the robot was lost at the end, 3 if nothing of the task was found,
    2 with one line on stderr for an error the operator can fix, else 0.
    """

    async def serve() -> int:
        settings = parse_arguments(arguments)
        with nullcontext() if settings.out is None else locked_folder(settings.out):
            return await _serve(settings)

    return run_service("gausslite-agent", serve)


async def _serve(settings: AgentSettings) -> int:
    """Build the agent, serve it and run its mission; close in reverse order. Returns the exit code."""
    _require_usable(settings)
    stream = None if settings.source is None else FrameStream.open(settings.source)
    source_notes = () if stream is None or settings.source is None else _report_source(settings.source, stream.source)
    saved = _read_saved(settings)
    loop, changes = asyncio.get_running_loop(), ChangeNotifier()
    with ExitStack() as stack:
        parser: TaskParser = DefaultParser()
        if settings.link.parser is not None:
            parser = stack.enter_context(ParserClient(settings.link.parser, tls=settings.tls))
        uplink = _open_uplink(settings, stack, has_restored_map=saved is not None)
        # a saved mission has its own
        folder = settings.prior if saved is None else None
        prior = open_prior_map(folder, {} if saved is None else saved.run.extra, settings.mission)
        estimators = _estimators(settings, stream, prior)
        worker = MappingWorker(
            settings.mission,
            settings.link.grid,
            estimators.build,
            uplink,
            on_change=lambda: _notify(loop, changes),
            load=settings.load,
            keyframe_upload=_keyframe_upload(settings.link, uplink),
            prior=prior,
        )
        stack.callback(worker.close)
        _follow_team_map(settings, worker, stack)
        resumed = None
        if saved is not None:
            await asyncio.wrap_future(worker.restore(saved))
            resumed, saved = saved.checkpoint, None
        # only the task of the command line waits for the parser to start; one of this process answers at once
        cancel = parser.close if isinstance(parser, ParserClient) else lambda: None
        first_parser = WaitingParser(parser, cancel=cancel)
        # on the page a person can point
        can_find = stream is not None or settings.perception.model is not None or settings.view is not None
        mission = AgentMission(settings, worker, first_parser, resumed, can_find, source_notes)
        servicer = AgentServicer(settings.agent_id, worker, mission, parser, changes)
        if settings.view is not None:
            page = load_pages("--view").service_page(settings.view, settings.listen, is_agent=True, tls=settings.tls)
            stack.enter_context(page)
        run_mission = functools.partial(_run_mission, settings, mission, stream, first_parser)
        services = [create(settings, worker, estimators, mission.save) for _, create in installed(Group.AGENT_SERVICES)]
        added = [stack.enter_context(service) for service in services]
        await serve_until_stopped(settings.listen, [servicer.service(), *added], run_mission, settings.tls)
        lost = mission.describe_lost_data()
        if lost:
            _log.error("%s", lost)
            return 1
        if worker.status().localisation is LocalisationState.LOST:
            return ROBOT_LOST
        return 0 if worker.status().has_found_task else TASK_NOT_FOUND


def _require_usable(settings: AgentSettings) -> None:
    """Raise at the start for settings that would otherwise fail with the first task or at the end of the mission."""
    if settings.up_axis is not None:
        unit_up_axis(settings.up_axis)
    RunPlan(settings.mission, settings.perception, prior=settings.prior).check(settings.out)
    if settings.state is not None:
        prepare_file(settings.state)
    if settings.link.team_map != NONE:
        load(Group.TEAM_MAPS, purpose="team-map")


def _read_saved(settings: AgentSettings) -> SavedMission | None:
    """Return the saved mission, None if there is none. Raises MapFileError, MismatchError."""
    if settings.state is None or not settings.state.exists():
        return None
    return SavedMission.read(settings.state, *settings.fixed_settings)


def _report_source(settings: SourceSettings, source: Source) -> tuple[str, ...]:
    """Log what the recording leaves out or contradicts, and return it for the status."""
    notes = source.notes
    if settings.require_poses:
        notes = (*as_recorded_notes(source), *open_calibrator().contradictions(source))
    for note in notes:
        _log.warning("%s: %s", settings.spec, note)
    return notes


def _estimators(settings: AgentSettings, stream: FrameStream | None, prior: PriorMap | None) -> EstimatorFactory:
    """Return the estimator factory. Raises InvalidInputError if nothing can find the task of the command line."""
    needs_detector = settings.view is None
    estimators = EstimatorFactory(settings.perception, lambda: _scene(settings, stream, prior), needs_detector)
    if settings.task is not None:
        estimators.require_detector()
    if settings.source is not None and stream is not None and settings.perception.model is None:
        for note in ground_truth_notes(settings.source.spec, stream.source):
            _log.info(note)
    return estimators


async def _run_mission(
    settings: AgentSettings, mission: AgentMission, stream: FrameStream | None, first_parser: WaitingParser
) -> None:
    """Map the stream, or assign the first task, then serve unless the agent should exit. A cancellation ends all."""
    if not mission.can_find:
        _log.warning("every AssignTask will fail: %s", NO_DETECTOR)
    begin = mission.assign_task if stream is None else functools.partial(mission.run, stream)
    work = asyncio.ensure_future(asyncio.to_thread(begin))
    try:
        with PeriodicSave(mission.save_if_mapping, settings.save_interval_s):
            await asyncio.shield(work)
            if not settings.exit_when_done or stream is None:
                await asyncio.Event().wait()
    finally:
        # the mission still sends and writes its results, so nothing that it uses may be closed before it ends
        mission.stop(settings.link.grace_s)
        first_parser.stop()
        await work
        await asyncio.to_thread(mission.finish)


def _open_uplink(settings: AgentSettings, stack: ExitStack, has_restored_map: bool) -> Uplink | None:
    link = settings.link
    if link.fusion is None:
        return None
    spool = Spool(link.spool, settings.agent_id, link.grid)
    client = FusionClient(link.fusion, mission_id=link.mission_id, tls=settings.tls, token=spool.token)
    uplink = Uplink(client, settings.agent_id, spool, link.grid, link.uplink, has_restored_map)
    stack.callback(uplink.close)
    return uplink


def _follow_team_map(settings: AgentSettings, worker: MappingWorker, stack: ExitStack) -> None:
    """Insert teammates' voxels of the task's region into the map, if team-map is set."""
    link = settings.link
    if link.fusion is None or link.team_map == NONE:
        return
    follow: OpenTeamMap = load(Group.TEAM_MAPS)
    client = FusionClient(link.fusion, mission_id=link.mission_id, tls=settings.tls)
    stack.callback(follow(client, settings.agent_id, link.team_map, worker).close)


def _keyframe_upload(link: ConnectionSettings, uplink: Uplink | None) -> KeyframeUpload | None:
    if uplink is None or link.keyframes == 0:
        return None
    return open_upload(uplink, link.grid, link.keyframes, link.keyframes_during_mission)


def _scene(settings: AgentSettings, stream: FrameStream | None, prior: PriorMap | None) -> SceneInfo:
    if stream is not None:
        source = stream.source if prior is None else prior.moved(stream.source)
        return SceneInfo(stream.source.up_axis, source.regions())
    return SceneInfo() if settings.up_axis is None else SceneInfo(unit_up_axis(settings.up_axis))


def _notify(loop: asyncio.AbstractEventLoop, changes: ChangeNotifier) -> None:
    if not loop.is_closed():
        loop.call_soon_threadsafe(changes.notify)
