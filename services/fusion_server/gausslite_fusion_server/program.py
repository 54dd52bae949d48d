"""Start the fusion server from the command line; SIGTERM and SIGINT end it after open calls."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.joint_refinement import rasterizer_of_backend
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.process.siblings import Sibling, sibling
from gausslite.wire.convert import decode_frame
from gausslite.wire.process import LogFormat, log_to_stderr, run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_fusion_server.maintenance import run_command
from gausslite_fusion_server.metrics import metrics_server
from gausslite_fusion_server.refinement_worker import RefinementWorker
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import MAINTENANCE_COMMANDS, PROGRAM, ServerSettings, parse_arguments
from gausslite_fusion_server.store_follower import ServerLeadership, follow_store

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


def _open_store(settings: ServerSettings) -> tuple[FusionStore, ServerLeadership | None]:
    """Return the store and, of a store that servers share, who leads. Raises InvalidInputError, StorageError."""
    if settings.store is None:
        return MemoryStore(), None
    if settings.shards is None:
        return SqliteStore(settings.store, settings.store_max_bytes), None
    ray_store = _open_ray_store(settings.store, settings.shards, settings)
    return ray_store, ray_store


def _open_engine(settings: ServerSettings, store: FusionStore, leadership: ServerLeadership | None) -> FusionEngine:
    if leadership is None:
        return FusionEngine(store, settings.fusion, decode_keyframe=decode_frame)
    leadership.renew()
    return FusionEngine(store, settings.fusion, _revision_of_one_server(), decode_frame, leadership.leads)


def _revision_of_one_server() -> int:
    """Return a first revision so that the revisions of servers that share a store differ.

    A watcher that changes the server then gets a snapshot, and not changes since another server's revision. A server
    would need 4096 revisions in each microsecond to reach those of one that started later.
    """
    return (time.time_ns() // 1000 << 12) + secrets.randbelow(1 << 12)


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
    store, leadership = _open_store(settings)
    with contextlib.closing(store):
        engine = _open_engine(settings, store, leadership)
        refinement = RefinementWorker(settings.refine, rasterizer_of_backend(settings.rasterizer))
        servicer = FusionServicer(engine, refinement)
        try:
            await _serve_mission(settings, engine, servicer, leadership)
        finally:
            servicer.close()
            # a full disk is in the log already
            with contextlib.suppress(StorageError):
                engine.save_counters()


async def _serve_mission(
    settings: ServerSettings, engine: FusionEngine, servicer: FusionServicer, leadership: ServerLeadership | None
) -> None:
    async def work_until_stopped() -> None:
        try:
            if leadership is None:
                await asyncio.Event().wait()
            else:
                await follow_store(engine, leadership, servicer.publish_changes)
        finally:
            # runs when the server begins to stop, so that open streams end with UNAVAILABLE
            servicer.drain()

    page: AbstractContextManager[None] = nullcontext()
    if settings.view is not None:
        live = sibling(Sibling.LIVE_PAGE)
        page = live.own_page(settings.view, settings.listen, is_agent=False, tls=settings.tls)
    with metrics_server(settings.metrics, engine), page:
        await serve_until_stopped(
            settings.listen, [servicer.service()], work_until_stopped, settings.tls, settings.limits, settings.health
        )
