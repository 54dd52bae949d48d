"""Start the fusion server from the command line, or maintain its store: backup, restore, verify."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import gc
import json
import logging
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial

from gausslite.domain.errors import GaussLiteError
from gausslite.fusion import store_maintenance
from gausslite.fusion.alignment import FrameAligner
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.store_maintenance import StoreReport
from gausslite.pages import load_pages
from gausslite.plugins import Group, find
from gausslite.process import print_message
from gausslite.render.choose import choose_rasterizer
from gausslite.wire.convert import decode_frame
from gausslite.wire.run_service import LogFormat, log_to_stderr, run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_fusion_server.metrics import metrics_server
from gausslite_fusion_server.refinement_worker import RefinementWorker
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import (
    MAINTENANCE_COMMANDS,
    PROGRAM,
    FrameUse,
    MaintenanceSettings,
    ServerSettings,
    parse_arguments,
    parse_maintenance,
)
from gausslite_fusion_server.stores import database_of, open_store

_log = logging.getLogger(__name__)
_SWITCH_INTERVAL_S = 0.001
_COLLECTION_THRESHOLDS = (2_000, 10, 100)


def run_command(arguments: Sequence[str]) -> int:
    """Run one of MAINTENANCE_COMMANDS, print what it did; return 0, 1 for damaged rows, 2 with one line on stderr."""
    options = parse_maintenance(arguments)
    try:
        return _run(options)
    except (GaussLiteError, OSError) as error:
        print_message(f"{PROGRAM} {options.command}: {error}")
        return 2


def _run(options: MaintenanceSettings) -> int:
    match options.command:
        case "backup":
            report = store_maintenance.back_up(options.store, options.other)
            _print(options, f"{options.other}: {_summary(report)}", dataclasses.asdict(report))
        case "restore":
            report, replaced = store_maintenance.restore(options.other, options.store)
            earlier = "" if replaced is None else f"; the earlier file is now {replaced}"
            text = f"{options.store}: {_summary(report)}; agents will send what is missing{earlier}"
            _print(options, text, dataclasses.asdict(report) | {"replaced": str(replaced or "")})
        case _:
            report = store_maintenance.verify(options.store, options.repair)
            done = " deleted; agents will send what is missing" if options.repair and report.damaged_rows else ""
            text = f"{options.store}: {_summary(report)}, {report.damaged_rows} damaged rows{done}"
            _print(options, text, dataclasses.asdict(report))
            return int(report.damaged_rows > 0 and not options.repair)
    return 0


def _summary(report: StoreReport) -> str:
    return f"{report.agents} agents, {report.voxels} voxels, {report.gaussians} Gaussians, {report.keyframes} keyframes"


def _print(options: MaintenanceSettings, text: str, values: dict[str, object]) -> None:
    sys.stdout.write((json.dumps(values) if options.json else text) + "\n")


def run(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal arrives, or run a maintenance command; return 0, or 2 with one line on stderr."""
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
    # an acknowledgement passes several threads, and each waits this long for one that computes
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    # a full collection reads every voxel's entry while nobody else works: 0.1 s with 1e7 Gaussians
    gc.set_threshold(*_COLLECTION_THRESHOLDS)
    if settings.peer_address is not None:
        await _serve_share(settings, settings.peer_address)
        return
    with contextlib.closing(open_store(settings)) as store:
        aligner = _open_aligner(settings)
        engine = FusionEngine(store, settings.fusion, decode_keyframe=decode_frame, aligner=aligner)
        refinement = RefinementWorker(settings.refine, partial(choose_rasterizer, settings.rasterizer))
        servicer = FusionServicer(engine, refinement)
        try:
            await _serve_mission(settings, engine, servicer)
        finally:
            if aligner is not None:
                # else the servicer waits for a comparison
                aligner.close()
            servicer.close()


def _page(settings: ServerSettings) -> AbstractContextManager[None]:
    if settings.view is None:
        return nullcontext()
    return load_pages("--view").service_page(settings.view, settings.listen, is_agent=False, tls=settings.tls)


async def _serve_mission(settings: ServerSettings, engine: FusionEngine, servicer: FusionServicer) -> None:
    async def work_until_stopped() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            # runs when the server begins to stop, so that open streams end with UNAVAILABLE
            servicer.drain()

    with metrics_server(settings.metrics, lambda: engine, engine.acknowledgements), _page(settings):
        await serve_until_stopped(
            settings.listen, [servicer.service()], work_until_stopped, settings.tls, settings.limits, settings.health
        )


async def _serve_share(settings: ServerSettings, peer_address: str) -> None:
    """Serve a part of a mission, together with the other servers of the database."""
    assert isinstance(settings.store, str)
    async with database_of(settings.store).open_share(settings, settings.store, peer_address) as share:
        metrics = metrics_server(settings.metrics, share.engine, share.acknowledgements, share.counts)
        with metrics, _page(settings):
            await serve_until_stopped(
                settings.listen, share.services, share.run, settings.tls, settings.limits, settings.health
            )
