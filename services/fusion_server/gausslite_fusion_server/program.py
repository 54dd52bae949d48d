"""Start the fusion server from the command line; SIGTERM and SIGINT end it after open calls."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

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
from gausslite_fusion_server.settings import (
    MAINTENANCE_COMMANDS,
    POSTGRES_SCHEME,
    PROGRAM,
    ServerSettings,
    parse_arguments,
)


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


def _open_database(url: str) -> FusionStore:
    try:
        # psycopg is an extra
        from gausslite.fusion.postgres_store import PostgresStore
    except ImportError as error:
        raise InvalidInputError(
            f"--store {POSTGRES_SCHEME}...: expected the package 'psycopg'; install it with: "
            "pip install 'gausslite[postgres]'"
        ) from error
    return PostgresStore(url)


def _open_store(settings: ServerSettings) -> FusionStore:
    """Return the store. Raises InvalidInputError, StorageError."""
    if settings.store is None:
        return MemoryStore()
    if isinstance(settings.store, str):
        return _open_database(settings.store)
    return SqliteStore(settings.store, settings.store_max_bytes)


async def _serve(settings: ServerSettings) -> None:
    store = _open_store(settings)
    with contextlib.closing(store):
        engine = FusionEngine(store, settings.fusion, decode_keyframe=decode_frame)
        refinement = RefinementWorker(settings.refine, rasterizer_of_backend(settings.rasterizer))
        servicer = FusionServicer(engine, refinement)
        try:
            await _serve_mission(settings, engine, servicer)
        finally:
            servicer.close()
            # a full disk is in the log already
            with contextlib.suppress(StorageError):
                engine.save_counters()


async def _serve_mission(settings: ServerSettings, engine: FusionEngine, servicer: FusionServicer) -> None:
    async def work_until_stopped() -> None:
        try:
            await asyncio.Event().wait()
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
