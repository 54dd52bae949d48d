"""Settings of the fusion server, read from its options."""

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
    """Address, storage (None: in memory) and limits of the server, and the mission that it serves."""

    listen: str = "127.0.0.1:50052"
    store: Path | None = None
    store_max_bytes: int | None = None
    fusion: FusionSettings = field(default_factory=FusionSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    rasterizer: str = "auto"
    tls: Tls | None = None


def parse_arguments(arguments: Sequence[str] | None = None) -> ServerSettings:
    """Return the settings of the options. Raises InvalidInputError for values that are out of range."""
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
        description="Store every agent's latest voxel updates and serve the fused map. In each voxel the agent with "
        "the largest sum of kappa (per Gaussian, the training steps in which it was visible and active) wins.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    defaults, quotas = ServerSettings(), Quotas()
    add = parser.add_argument
    add("--listen", default=defaults.listen, metavar="ADDRESS", help="HOST:PORT or unix:PATH")
    add("--store", default=MEMORY, metavar="memory|PATH.sqlite", help="storage of the voxel updates")
    add("--store-max-mb", type=int, metavar="MB", help="largest size of the SQLite file; no limit if absent")
    add("--voxel-size", type=float, default=defaults.fusion.grid.size_m, metavar="M", help="edge of voxels in metres")
    add("--mission", default="", metavar="ID", help="the only mission to serve; empty: that of the first agent")
    add("--world-frame", default="", metavar="NAME", help="frame of all maps; empty: that of the first agent")
    add("--quota-agents", type=int, default=quotas.agents, metavar="N", help="largest number of agents")
    add("--quota-voxels", type=int, default=quotas.voxels_per_agent, metavar="N", help="largest number per agent")
    add("--quota-gaussians", type=int, default=quotas.gaussians_per_agent, metavar="N", help="largest number per agent")
    add("--quota-keyframes", type=int, default=quotas.keyframes_per_agent, metavar="N", help="largest number per agent")
    add("--quota-keyframe-pixels", type=int, default=quotas.keyframe_pixels, metavar="N", help="largest keyframe image")
    add(
        "--refine-iterations",
        type=int,
        default=defaults.refine.iterations,
        metavar="N",
        help="iterations of joint refinement if a request states none",
    )
    add("--rasterizer", choices=BACKENDS, default=defaults.rasterizer, help="backend of the refinement")
    add_tls(parser)
    return parser
