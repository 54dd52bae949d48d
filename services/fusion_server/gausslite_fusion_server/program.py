"""Start the fusion server from the command line, or run one of its commands that a plug-in adds."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial

from gausslite.domain.errors import MissingPluginError
from gausslite.fusion.alignment import FrameAligner
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.traffic import Acknowledgements
from gausslite.pages import load_pages
from gausslite.plugins import Group, find, load, names
from gausslite.process import print_message, return_free_memory
from gausslite.render.choose import choose_rasterizer
from gausslite.wire.convert import decode_frame
from gausslite.wire.run_service import LogFormat, log_to_stderr, run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_fusion_server.plugins import (
    FindCounts,
    FindEngine,
    MetricsServer,
    added_services,
    database_of,
    open_store,
)
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import PROGRAM, FrameUse, ServerSettings, parse_arguments

_log = logging.getLogger(__name__)
_COLLECTION_THRESHOLDS = (2_000, 10, 100)  # a full collection of a large map takes 0.1 s: make it rare


def run(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal arrives, or run a command of a plug-in; return 0, or 2 with one line on stderr."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in names(Group.SERVER_COMMANDS):
        try:
            command: Callable[[Sequence[str]], int] = load(Group.SERVER_COMMANDS, given[0])
        except MissingPluginError as error:
            print_message(f"{PROGRAM}: {error}")
            return 2
        return command(given)

    async def serve() -> int:
        settings = parse_arguments(arguments)
        if settings.log_format is LogFormat.JSON:
            log_to_stderr(PROGRAM, LogFormat.JSON)
        await _serve(settings)
        return 0

    return run_service(PROGRAM, serve)


def _open_aligner(settings: ServerSettings) -> FrameAligner | None:
    """Return what compares agents' frames; None if they are used as declared."""
    if settings.frame_alignment is FrameUse.TRUST:
        return None
    create = find(Group.ALIGNERS)
    if create is None:
        _log.warning("agents' frames are used as declared: no plug-in of %s is installed", Group.ALIGNERS)
        return None
    aligner: FrameAligner = create(settings.fusion.grid)
    return aligner


async def _serve(settings: ServerSettings) -> None:
    # a full collection reads every voxel's entry while nobody else works: 0.1 s with 1e7 Gaussians
    gc.set_threshold(*_COLLECTION_THRESHOLDS)
    if settings.peer_address is not None:
        await _serve_share(settings, settings.peer_address)
        return
    with contextlib.closing(open_store(settings)) as store:
        aligner = _open_aligner(settings)
        engine = FusionEngine(store, settings.fusion, decode_keyframe=decode_frame, aligner=aligner)
        # the first vote on a whole map takes several times the memory that stays
        return_free_memory()
        servicer = FusionServicer(engine, settings.refine, partial(choose_rasterizer, settings.rasterizer))
        try:
            await _serve_mission(settings, engine, servicer)
        finally:
            if aligner is not None:
                # ends a comparison that runs, for which `servicer.close` would wait
                aligner.close()
            servicer.close()


def _metrics(
    settings: ServerSettings, engine: FindEngine, acknowledgements: Acknowledgements, counts: FindCounts | None = None
) -> AbstractContextManager[int]:
    """Serve the figures while the context is open. Raises MissingPluginError, which names what is not installed."""
    if settings.metrics is None:
        return nullcontext(0)
    serve: MetricsServer = load(Group.METRICS, purpose="--metrics")
    return serve(settings.metrics, engine, acknowledgements, counts)


def _page(settings: ServerSettings) -> AbstractContextManager[None]:
    if settings.view is None:
        return nullcontext()
    return load_pages("--view").service_page(settings.view, settings.listen, is_agent=False, tls=settings.tls)


async def _serve_mission(settings: ServerSettings, engine: FusionEngine, servicer: FusionServicer) -> None:
    async def work_until_stopped() -> None:
        servicer.publish_changes()
        try:
            await asyncio.Event().wait()
        finally:
            # runs when the server begins to stop, so that open streams end with UNAVAILABLE
            servicer.drain()

    services = [servicer.service(), *added_services(lambda: engine)]
    with _metrics(settings, lambda: engine, engine.acknowledgements), _page(settings):
        await serve_until_stopped(
            settings.listen, services, work_until_stopped, settings.tls, settings.limits, settings.health
        )


async def _serve_share(settings: ServerSettings, peer_address: str) -> None:
    """Serve a part of a mission, together with the other servers of the database."""
    assert isinstance(settings.store, str)
    async with database_of(settings.store).open_share(settings, settings.store, peer_address) as share:
        metrics = _metrics(settings, share.engine, share.acknowledgements, share.counts)
        services = [*share.services, *added_services(share.engine)]
        with metrics, _page(settings):
            await serve_until_stopped(
                settings.listen, services, share.run, settings.tls, settings.limits, settings.health
            )
