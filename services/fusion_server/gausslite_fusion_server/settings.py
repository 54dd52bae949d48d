"""Settings of the fusion server, read from its options."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.default_addresses import FUSION_ADDRESS
from gausslite.config.layers import parse_options
from gausslite.config.mapping_options import add_rasterizer, add_voxel_size
from gausslite.config.numbers import Number
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.config.toml_text import without_password
from gausslite.config.view_option import add_view
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.frame_alignment import AlignmentSettings
from gausslite.fusion.joint_refinement import RefineSettings
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS, FusionSettings, Quotas
from gausslite.process.messages import print_message
from gausslite.wire.address import host_and_port
from gausslite.wire.call_limits import CallLimits
from gausslite.wire.process import LogFormat
from gausslite.wire.tls import Tls

PROGRAM = "gausslite-fusion-server"
MEMORY = "memory"
STORE_SUFFIX = ".sqlite"
POSTGRES_SCHEME = "postgresql://"
_CORRECT, _TRUST = "correct", "trust"
_MAX_STORE_MB = 1 << 24
_MAINTENANCE = (
    ("backup", ("store", "target"), "copy a store to a new file and verify the copy; a server may be using it"),
    ("restore", ("backup", "store"), "replace a store by a backup; the earlier file is kept under another name"),
    ("verify", ("store",), "check every row; a server may be using the store"),
    ("compact", ("store",), "rewrite the file without unused space; no server may be using it"),
)
MAINTENANCE_COMMANDS = tuple(name for name, _, _ in _MAINTENANCE)


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Address, storage (a file, the URL of a PostgreSQL database, or memory) and limits of the server, and the mission.

    view: port of the page that shows the server, None for no page. health: own address for health checks, None for
    none.
    """

    listen: str = FUSION_ADDRESS
    store: Path | None = None
    database: str | None = field(default=None, repr=False)
    store_max_bytes: int | None = None
    fusion: FusionSettings = field(default_factory=FusionSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    rasterizer: str = "auto"
    tls: Tls | None = None
    limits: CallLimits = field(default_factory=CallLimits)
    log_format: LogFormat = LogFormat.TEXT
    metrics: str | None = None
    view: int | None = None
    health: str | None = None


@dataclass(frozen=True, slots=True)
class MaintenanceSettings:
    """A maintenance command of a store's file. other: the new copy of `backup`, the source of `restore`."""

    command: str
    store: Path
    other: Path
    json: bool
    repair: bool


def parse_arguments(arguments: Sequence[str] | None = None) -> ServerSettings:
    """Return the settings of the options. Raises InvalidInputError for values that are out of range."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    _require_store(options)
    is_database = options.store.startswith(POSTGRES_SCHEME)
    if options.health is not None:
        host_and_port("--health", options.health)
    quotas = Quotas(
        options.quota_agents,
        options.quota_voxels,
        options.quota_gaussians,
        options.quota_keyframes,
        options.quota_keyframe_pixels,
    )
    return ServerSettings(
        options.listen,
        None if options.store == MEMORY or is_database else Path(options.store),
        options.store if is_database else None,
        None if options.store_max_mb is None else options.store_max_mb << 20,
        FusionSettings(
            VoxelGrid(options.voxel_size),
            options.mission,
            options.world_frame,
            quotas,
            alignment=None if options.frame_alignment == _TRUST else AlignmentSettings(),
        ),
        RefineSettings(iterations=options.refine_iterations),
        options.rasterizer,
        read_server_tls(options),
        CallLimits(options.limit_calls, options.limit_kbps, options.limit_connections, options.limit_idle),
        LogFormat(options.log_format),
        options.metrics,
        options.view,
        options.health,
    )


def _require_store(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for a --store of another kind than the other options need, or for a misspelt one."""
    if options.store == MEMORY:
        return
    if options.store.startswith(POSTGRES_SCHEME):
        if options.store_max_mb is not None:
            raise InvalidInputError("--store-max-mb: expected a file as --store, got a database")
        return
    path = Path(options.store)
    if path.is_dir():
        missions = f"; start one server for each mission in the folder: --store FILE{STORE_SUFFIX}"
        has_missions = any(path.glob(f"*{STORE_SUFFIX}"))
        raise InvalidInputError(f"--store {path}: expected a file, got a folder{missions if has_missions else ''}")
    if path.suffix != STORE_SUFFIX and not path.exists():
        raise InvalidInputError(
            f"--store {without_password(options.store)}: expected {MEMORY} or the name of a file that ends in "
            f"{STORE_SUFFIX}, or {POSTGRES_SCHEME}USER@HOST/DATABASE"
        )


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of `gausslite-fusion-server`, without the options of configuration files."""
    parser = CommandParser(
        prog=PROGRAM,
        description="Store every agent's latest voxel updates and serve the fused map. In each voxel the agent with "
        "the largest sum of kappa (per Gaussian, the training steps in which it was visible and active) wins.",
        epilog=f"Commands that maintain the file of a store: {', '.join(MAINTENANCE_COMMANDS)}. `{PROGRAM} COMMAND "
        "--help` describes each.",
    )
    defaults, quotas = ServerSettings(), Quotas()
    add = parser.add_argument
    add("--listen", default=defaults.listen, metavar="ADDRESS", help="HOST:PORT or unix:PATH (default: %(default)s)")
    storage = "storage of the voxel updates (default: memory)"
    add("--store", default=MEMORY, metavar="memory|PATH.sqlite|postgresql://USER@HOST/DATABASE", help=storage)
    max_mb = Number("store-max-mb", int, 1, _MAX_STORE_MB)
    add("--store-max-mb", type=max_mb, metavar="MB", help="largest size of the SQLite file (default: no limit)")
    add_voxel_size(parser)
    add("--mission", default="", metavar="ID", help="the mission to serve (default: the first agent's)")
    add("--world-frame", default="", metavar="NAME", help="frame of all maps (default: the first agent's)")
    add(
        "--frame-alignment",
        choices=[_CORRECT, _TRUST],
        default=_CORRECT,
        help="correct the misfit of agents' frames and quarantine gross ones, or trust them (default: %(default)s)",
    )
    for name, default, meaning in (
        ("agents", quotas.agents, "agents"),
        ("voxels", quotas.voxels_per_agent, "voxels per agent"),
        ("gaussians", quotas.gaussians_per_agent, "Gaussians per agent"),
        ("keyframes", quotas.keyframes_per_agent, "keyframes per agent"),
        ("keyframe-pixels", quotas.keyframe_pixels, "pixels of a keyframe"),
    ):
        help_text = f"largest number of {meaning} (default: %(default)s)"
        add(f"--quota-{name}", type=int, default=default, metavar="N", help=help_text)
    add(
        "--refine-iterations",
        type=Number("refine-iterations", int, 1, MAX_REFINE_ITERATIONS),
        default=defaults.refine.iterations,
        metavar="N",
        help="iterations of joint refinement if a request states none (default: %(default)s)",
    )
    add_rasterizer(add, "backend of the refinement")
    limits = defaults.limits
    for name, default, metavar, meaning in (
        ("calls", limits.calls, "N", "number of open calls of one caller"),
        ("kbps", limits.kbps, "KBPS", "bandwidth of one caller's requests, in kilobits per second"),
        ("connections", limits.connections, "N", "number of connections"),
        ("idle", limits.idle_s, "S", "time of a connection without a call, in seconds"),
    ):
        add(
            f"--limit-{name}",
            type=int,
            default=default,
            metavar=metavar,
            help=f"largest {meaning} (default: %(default)s)",
        )
    add(
        "--log-format",
        choices=[str(each) for each in LogFormat],
        default=str(LogFormat.TEXT),
        help="lines of the log (default: %(default)s)",
    )
    add("--metrics", metavar="HOST:PORT", help="serve figures for Prometheus there over HTTP (default: no)")
    add("--health", metavar="HOST:PORT", help="answer health checks also there, without encryption (default: no)")
    add_view(parser, "the fused map")
    add_tls(parser)
    return parser


def parse_maintenance(arguments: Sequence[str]) -> MaintenanceSettings:
    """Return the settings of a maintenance command."""
    options = _maintenance_parser().parse_args(arguments)
    other = getattr(options, "target", None) or getattr(options, "backup", options.store)
    return MaintenanceSettings(options.command, options.store, other, options.json, getattr(options, "repair", False))


def build_parser_with_commands() -> argparse.ArgumentParser:
    """Return the parser of the server's options and of the maintenance commands, for the completion of a shell."""
    parser = build_parser()
    _add_maintenance_commands(parser, required=False)
    return parser


def _maintenance_parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog=PROGRAM, description="Maintain the file of a store.")
    _add_maintenance_commands(parser, required=True)
    return parser


def _add_maintenance_commands(parser: argparse.ArgumentParser, *, required: bool) -> None:
    commands = parser.add_subparsers(dest="command", required=required, metavar="COMMAND")
    for name, paths, text in _MAINTENANCE:
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        for path in paths:
            command.add_argument(path, type=Path, metavar=path.upper())
        command.add_argument("--json", action="store_true", help="print one JSON object")
        if name == "verify":
            command.add_argument("--repair", action="store_true", help="delete the damaged rows; without a server")
