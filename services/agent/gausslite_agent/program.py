"""One robot as a process, until its mission or the operator ends it."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Sequence
from contextlib import ExitStack

from gausslite.datasets.open import is_simulated
from gausslite.domain.pose import unit_up_axis
from gausslite.mission.build import RelevanceEstimatorFactory
from gausslite.mission.results import prepare_file, prepare_folder
from gausslite.mission.settings import SceneInfo
from gausslite.task.parser import TaskParser
from gausslite.task.rules import RuleParser
from gausslite.wire.change_notifier import ChangeNotifier
from gausslite.wire.clients import FusionClient, ParserClient
from gausslite.wire.process import run_service
from gausslite.wire.server import serve_until_stopped
from gausslite.wire.spool import Spool
from gausslite.wire.uplink import Uplink
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission_checkpoint import SavedAgentMission
from gausslite_agent.mission_runner import AgentMission
from gausslite_agent.replay_source import ReplaySource
from gausslite_agent.servicer import AgentServicer
from gausslite_agent.settings import AgentSettings, parse_arguments


def run(arguments: Sequence[str] | None = None) -> int:
    """0 after a clean end, 2 with one line on stderr when something the operator can mend is wrong."""

    async def serve() -> None:
        await _serve(parse_arguments(arguments))

    return run_service("gausslite-agent", serve)


async def _serve(settings: AgentSettings) -> None:
    """Build the robot, serve it, play its source; close in the reverse order."""
    _require_usable(settings)
    stand_in = None if settings.play is None else ReplaySource.open(settings.play, settings.up_axis)
    saved = _saved_mission(settings)
    loop, news = asyncio.get_running_loop(), ChangeNotifier()
    with ExitStack() as stack:
        # the task of the command line may wait for a parser to start; who assigns one is told that there is none
        at_start, asked = (_parser(settings, stack, patient) for patient in (True, False))
        uplink, client = _uplink(settings, stack, has_restored_map=saved is not None)
        attentions = RelevanceEstimatorFactory(settings.perception, lambda: _scene(settings, stand_in))
        if settings.task is not None and not (settings.play and is_simulated(settings.play.source)):
            attentions.require_sight()
        robot = MappingWorker(
            settings.mission,
            settings.link.grid,
            attentions.to,
            uplink,
            on_change=lambda: _ring(loop, news),
            load=settings.load,
        )
        stack.callback(robot.close)
        earlier = None
        if saved is not None:
            await asyncio.wrap_future(robot.resume(saved))
            earlier, saved = saved.life, None
        player = AgentMission(settings, robot, at_start, client, earlier)
        servicer = AgentServicer(settings.agent_id, robot, asked, news, lambda: player.state)

        mission = functools.partial(_live, settings, stand_in, player, uplink)
        await serve_until_stopped(settings.listen, [servicer.service()], mission, settings.tls)


def _require_usable(settings: AgentSettings) -> None:
    """Raise for what would end the mission later, hours into it or with its first task."""
    if settings.up_axis is not None:
        unit_up_axis(settings.up_axis)
    if settings.out is not None:
        prepare_folder(settings.out)
    if settings.state is not None:
        prepare_file(settings.state)


def _saved_mission(settings: AgentSettings) -> SavedAgentMission | None:
    """The mission of an earlier life. Raises MapFileError, MismatchError."""
    if settings.state is None or not settings.state.exists():
        return None
    return SavedAgentMission.read(settings.state, settings.terms)


async def _live(
    settings: AgentSettings, stand_in: ReplaySource | None, player: AgentMission, uplink: Uplink | None
) -> None:
    """Work through the mission, then serve on unless told otherwise; what is mapped then is written at the end."""
    work = asyncio.ensure_future(asyncio.to_thread(_begin, stand_in, player))
    try:
        await asyncio.shield(work)
        if not settings.exit_when_done or stand_in is None:
            await asyncio.Event().wait()
    finally:
        # the player still writes what it has; nothing it uses may close before that
        player.stop()
        if uplink is not None:
            uplink.cancel_drain()
        await work
        if stand_in is None:
            await asyncio.to_thread(player.conclude)


def _begin(stand_in: ReplaySource | None, player: AgentMission) -> None:
    """Play the source, or take the task and wait for frames."""
    if stand_in is not None:
        player.play(stand_in)
    else:
        player.begin()


def _parser(settings: AgentSettings, stack: ExitStack, patient: bool) -> TaskParser:
    if settings.link.parser is None:
        return RuleParser()
    return stack.enter_context(ParserClient(settings.link.parser, patient=patient, tls=settings.tls))


def _uplink(settings: AgentSettings, stack: ExitStack, has_restored_map: bool) -> tuple[Uplink | None, FusionClient | None]:
    link = settings.link
    if link.fusion is None:
        return None, None
    spool = Spool(link.spool, settings.agent_id, link.grid)
    client = FusionClient(link.fusion, mission_id=link.mission_id, tls=settings.tls)
    uplink = Uplink(client, settings.agent_id, spool, link.grid, link.uplink, has_restored_map)
    stack.callback(uplink.close)
    return uplink, client


def _scene(settings: AgentSettings, stand_in: ReplaySource | None) -> SceneInfo:
    if stand_in is not None:
        return SceneInfo.of(stand_in.source)
    return SceneInfo() if settings.up_axis is None else SceneInfo(unit_up_axis(settings.up_axis))


def _ring(loop: asyncio.AbstractEventLoop, news: ChangeNotifier) -> None:
    if not loop.is_closed():
        loop.call_soon_threadsafe(news.notify)
