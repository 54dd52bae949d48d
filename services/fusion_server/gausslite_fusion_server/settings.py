"""Settings of the fusion server, read from its options."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.plain_values import without_password
from gausslite.config.program import Program, parse_options
from gausslite.config.values import read_path
from gausslite.domain.errors import InvalidInputError
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.refinement import RefineSettings
from gausslite.plugins import Group, names
from gausslite.process import print_message
from gausslite.render.choose import backends
from gausslite.wire.call_limits import CallLimits
from gausslite.wire.channel import FUSION_ADDRESS, MAX_PORT, host_and_port, require_callable
from gausslite.wire.run_service import LogFormat
from gausslite.wire.security import Tls, TlsFiles

PROGRAM = "gausslite-fusion-server"
MEMORY = "memory"
STORE_SUFFIX = ".sqlite"
_DATABASE = "postgresql://USER@HOST/DATABASE"
"""An example: the plug-in of a store has the name of the scheme."""
_MAX_STORE_MB = 1 << 24


class FrameUse(StrEnum):
    """What the server does with the frames that agents declare."""

    CORRECT = "correct"
    TRUST = "trust"


def _read_store(text: str) -> Path | str | None:
    if text == MEMORY:
        return None
    return text if "://" in text else read_path(text)


def _read_health(text: str) -> str:
    host_and_port("health", text)
    return text


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Address, storage (a file, the URL of a database, or memory) and limits of the server; the mission."""

    listen: str = option(FUSION_ADDRESS, "HOST:PORT or unix:PATH", metavar="ADDRESS")
    store: Path | str | None = option(
        None,
        "storage of the voxel updates (default: memory)",
        metavar=f"{MEMORY}|PATH{STORE_SUFFIX}|{_DATABASE}",
        plain_type=str,
        convert=_read_store,
        to_plain=str,
    )
    store_max_bytes: int | None = option(
        None,
        "largest size of the SQLite file (default: no limit)",
        key="store-max-mb",
        unit="MiB",
        low=1,
        high=_MAX_STORE_MB,
        convert=lambda mebibytes: mebibytes << 20,
        to_plain=lambda size: size >> 20,
    )
    peer_address: str | None = option(
        None,
        "where the other servers of the database reach this one: servers with it share the mission (default: alone)",
        metavar="ADDRESS",
        convert=partial(require_callable, "peer-address"),
    )
    fusion: FusionSettings = field(default_factory=FusionSettings)
    frame_alignment: FrameUse = option(
        FrameUse.CORRECT, "correct the misfit of agents' frames and quarantine gross ones, or trust them"
    )
    refine: RefineSettings = field(default_factory=RefineSettings)
    rasterizer: str = option("auto", "backend of the refinement", choices=backends())
    tls: Tls | None = None
    limits: CallLimits = field(default_factory=CallLimits)
    log_format: LogFormat = option(LogFormat.TEXT, "lines of the log")
    metrics: str | None = option(
        None, "serve figures for Prometheus there over HTTP (default: no)", metavar="HOST:PORT"
    )
    view: int | None = option(
        None,
        "show the fused map on a page at http://127.0.0.1:PORT while it grows; 0 chooses a port (extra: view)",
        metavar="PORT",
        low=0,
        high=MAX_PORT,
    )
    health: str | None = option(
        None,
        "answer health checks also there, without encryption (default: no)",
        metavar="HOST:PORT",
        convert=_read_health,
    )


OPTIONS = Program.of(
    *(ServerSettings, TlsFiles),
    flags="listen store mission world-frame voxel-size view metrics log-format tls-cert tls-key tls-ca",
)


def parse_arguments(arguments: Sequence[str] | None = None) -> ServerSettings:
    """Return the settings of the options. Raises InvalidInputError for values that are out of range."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    _require_store(options)
    return build(ServerSettings, options, tls=build(TlsFiles, options).read_for_server())


def _require_store(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for a store of another kind than the other options need, or for a misspelt one."""
    store = options.store
    if options.peer_address is not None and not isinstance(store, str):
        raise InvalidInputError(f"peer-address: expected a database as --store, {_DATABASE}")
    if store is None:
        return
    if isinstance(store, str):
        if options.store_max_mb is not None:
            raise InvalidInputError("store-max-mb: expected a file as --store, got a database")
    elif store.is_dir():
        missions = f"; start one server for each mission in the folder: --store FILE{STORE_SUFFIX}"
        has_missions = any(store.glob(f"*{STORE_SUFFIX}"))
        raise InvalidInputError(f"--store {store}: expected a file, got a folder{missions if has_missions else ''}")
    elif store.suffix != STORE_SUFFIX and not store.exists():
        raise InvalidInputError(
            f"--store {without_password(str(store))}: expected {MEMORY} or the name of a file that ends in "
            f"{STORE_SUFFIX}, or {_DATABASE}"
        )


def build_parser() -> CommandParser:
    """Return the parser of `gausslite-fusion-server`."""
    parser = CommandParser(
        prog=PROGRAM,
        description="Store every agent's latest voxel updates and serve the fused map. In each voxel the agent with "
        "the largest sum of kappa (per Gaussian, the training steps in which it was visible and active) wins, or one "
        "whose error in the agents' keyframes is less than half as large.",
        epilog=f"Commands that maintain the file of a store: {', '.join(names(Group.SERVER_COMMANDS))}. "
        f"`{PROGRAM} COMMAND --help` describes each.",
    )
    OPTIONS.add_to(parser)
    return parser
