"""Start the fusion server from the command line; SIGTERM and SIGINT end it after open calls."""

from __future__ import annotations

import asyncio
import secrets
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.domain.errors import InvalidInputError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.joint_refinement import rasterizer_of_backend
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.view.live_page import own_page
from gausslite.wire.convert import decode_frame
from gausslite.wire.process import LogFormat, log_to_stderr, run_service
from gausslite.wire.server import serve_until_stopped
from gausslite.wire.tracing import tracing
from gausslite_fusion_server.maintenance import run_command
from gausslite_fusion_server.metrics import metrics_server
from gausslite_fusion_server.mission_router import MissionRouter
from gausslite_fusion_server.missions import Mission, Missions, mission_file, stored_missions
from gausslite_fusion_server.refinement_worker import RefinementWorker
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import MAINTENANCE_COMMANDS, PROGRAM, ServerSettings, parse_arguments
from gausslite_fusion_server.store_follower import ServerLeadership

if TYPE_CHECKING:
    from gausslite.cluster.ray_store import RayStore


def run(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal arrives, or run a maintenance command.

    Returns the exit code: 0, or 2 with one line on stderr if the server fails.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in MAINTENANCE_COMMANDS:
        return run_command(given)

    async def serve() -> int:
        settings = parse_arguments(arguments)
        if settings.log_format is LogFormat.JSON:
            log_to_stderr(PROGRAM, LogFormat.JSON)
        await _serve(settings)
        return 0

    return run_service(PROGRAM, serve)


def _open_missions(settings: ServerSettings) -> Missions:
    """Open the stored missions. Raises InvalidInputError, QuotaError, StorageError."""

    def open_mission(mission_id: str) -> Mission:
        fusion = replace(settings.fusion, mission_id=mission_id) if mission_id else settings.fusion
        if settings.store is not None and settings.shards is not None:
            ray_store = _open_ray_store(settings.store, settings.shards, settings)
            return _open_mission(settings, fusion, ray_store, leadership=ray_store)
        store, file = _open_store(settings, mission_id), _file_of(settings, mission_id)
        return _open_mission(settings, fusion, store, file)

    has_folder = settings.max_missions > 1 and settings.store is not None
    stored = stored_missions(settings.store) if has_folder and settings.store is not None else ()
    return Missions(open_mission, settings.max_missions, stored)


def _open_mission(
    settings: ServerSettings,
    fusion: FusionSettings,
    store: FusionStore,
    file: Path | None = None,
    leadership: ServerLeadership | None = None,
) -> Mission:
    try:
        if leadership is None:
            engine = FusionEngine(store, fusion, decode_keyframe=decode_frame)
        else:
            leadership.renew()
            engine = FusionEngine(store, fusion, _revision_of_one_server(), decode_frame, leadership.leads)
    except BaseException:
        store.close()
        raise
    refinement = RefinementWorker(settings.refine, rasterizer_of_backend(settings.rasterizer))
    return Mission(store, engine, FusionServicer(engine, refinement), file, leadership)


def _revision_of_one_server() -> int:
    """Return a first revision so that the revisions of servers that share a store differ.

    A watcher that changes the server then gets a snapshot, and not changes since another server's revision. A server
    would need 4096 revisions in each microsecond to reach those of one that started later.
    """
    return (time.time_ns() // 1000 << 12) + secrets.randbelow(1 << 12)


def _open_store(settings: ServerSettings, mission_id: str) -> FusionStore:
    if settings.store is None:
        return MemoryStore()
    return SqliteStore(_file_of(settings, mission_id) or settings.store, settings.store_max_bytes)


def _file_of(settings: ServerSettings, mission_id: str) -> Path | None:
    """Return the file of one of several missions; None in memory and for the only mission."""
    return mission_file(settings.store, mission_id) if mission_id and settings.store is not None else None


def _open_ray_store(folder: Path, shards: int, settings: ServerSettings) -> RayStore:
    try:
        # Ray is large, and an extra
        from gausslite.cluster.ray_store import RaySettings, RayStore
    except ModuleNotFoundError as error:
        raise InvalidInputError(
            "--shards: expected the package 'ray'; install it with: pip install 'gausslite[ray]'"
        ) from error
    return RayStore(RaySettings(folder, shards, settings.ray_address, settings.store_max_bytes))


async def _serve(settings: ServerSettings) -> None:
    missions = _open_missions(settings)
    service = missions.only.servicer.service() if settings.max_missions == 1 else MissionRouter(missions).service()

    async def work_until_stopped() -> None:
        try:
            # a store that servers share holds one mission
            await (missions.only.follow_others() if settings.max_missions == 1 else asyncio.Event().wait())
        finally:
            # runs when the server begins to stop, so that open streams end with UNAVAILABLE
            missions.drain()

    try:
        page = own_page(settings.view, settings.listen, is_agent=False, tls=settings.tls)
        with tracing(settings.traces, PROGRAM), metrics_server(settings.metrics, missions.engines), page:
            await serve_until_stopped(
                settings.listen, [service], work_until_stopped, settings.tls, settings.limits, settings.health
            )
    finally:
        missions.close()
