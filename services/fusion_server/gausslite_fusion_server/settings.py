"""Read the command line of the fusion server into settings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.config.layers import parse_options
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.fusion.joint_refinement import RefineSettings
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS, FusionSettings, Quotas
from gausslite.render.choose import BACKENDS
from gausslite.wire.tls import Tls

MEMORY = "memory"
_MAX_STORE_MB = 1 << 24


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Where to listen, where to keep the words (None = in memory) and on what terms agents join."""

    listen: str = "127.0.0.1:50052"
    store: Path | None = None
    store_max_bytes: int | None = None
    fusion: FusionSettings = field(default_factory=FusionSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    rasterizer: str = "auto"
    tls: Tls | None = None


def parse_arguments(arguments: Sequence[str] | None = None) -> ServerSettings:
    """Settings from the command line. Raises InvalidInputError for values that make no sense."""
    options = parse_options(_parser(), arguments)
    if options.store_max_mb is not None and not 1 <= options.store_max_mb <= _MAX_STORE_MB:
        raise InvalidInputError(f"--store-max-mb: expected 1 to {_MAX_STORE_MB}, got {options.store_max_mb}")
    if options.refine_iterations > MAX_REFINE_ITERATIONS:
        raise InvalidInputError(
            f"--refine-iterations: expected 1 to {MAX_REFINE_ITERATIONS}, got {options.refine_iterations}"
        )
    quotas = Quotas(
        options.quota_agents,
        options.quota_voxels,
        options.quota_gaussians,
        options.quota_keyframes,
        options.quota_keyframe_pixels,
    )
    return ServerSettings(
        options.listen,
        None if options.store == MEMORY else Path(options.store),
        None if options.store_max_mb is None else options.store_max_mb << 20,
        FusionSettings(VoxelGrid(options.voxel_size), options.mission, options.world_frame, quotas),
        RefineSettings(iterations=options.refine_iterations),
        options.rasterizer,
        read_server_tls(options),
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gausslite-fusion-server",
        description="Keep every agent's latest word on each voxel and serve the best-trained one to the team.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    ours, quotas = ServerSettings(), Quotas()
    add = parser.add_argument
    add("--listen", default=ours.listen, metavar="HOST:PORT", help="address to serve on, or unix:PATH")
    add("--store", default=MEMORY, metavar="memory|PATH.sqlite", help="where the words are kept")
    add("--store-max-mb", type=int, metavar="MB", help="largest size of the sqlite file; no limit when absent")
    add("--voxel-size", type=float, default=ours.fusion.grid.size_m, metavar="METRES", help="edge of the vote's voxels")
    add("--mission", default="", metavar="ID", help="the only mission to serve; empty: the first agent names it")
    add("--world-frame", default="", metavar="NAME", help="frame of all maps; empty: the first agent names it")
    add("--quota-agents", type=int, default=quotas.agents, metavar="N", help="most agents in the mission")
    add("--quota-voxels", type=int, default=quotas.voxels_per_agent, metavar="N", help="most voxels of an agent")
    add(
        "--quota-gaussians",
        type=int,
        default=quotas.gaussians_per_agent,
        metavar="N",
        help="most of an agent",
    )
    add(
        "--quota-keyframes",
        type=int,
        default=quotas.keyframes_per_agent,
        metavar="N",
        help="kept of an agent",
    )
    add("--quota-keyframe-pixels", type=int, default=quotas.keyframe_pixels, metavar="N", help="largest keyframe image")
    add("--refine-iterations", type=int, default=ours.refine.iterations, metavar="N", help="when a request names none")
    add("--rasterizer", choices=BACKENDS, default=ours.rasterizer, help="backend of the refinement")
    add_tls(parser)
    return parser
