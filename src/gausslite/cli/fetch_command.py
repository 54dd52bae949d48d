"""`gausslite fetch`: download the fused map of a running team."""

from __future__ import annotations

import argparse

from gausslite.cli.team_options import add_address, fusion_client
from gausslite.codec.files import write_atomic
from gausslite.config.values import read_path
from gausslite.mission.results import MAP_FILE, prepare_file
from gausslite.wire.clients import Export

_STRATEGIES = ("vote", "refined", "concatenation")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite fetch`."""
    add_address(parser, "the fusion server")
    add = parser.add_argument
    add("--out", metavar="FILE.ply", type=read_path, required=True, help="the file to write")
    add(
        "--strategy",
        choices=_STRATEGIES,
        default=_STRATEGIES[0],
        help="the winner of each voxel, the latest refinement, or all agents' Gaussians (default: %(default)s)",
    )
    add("--agent", metavar="NAME", default="", help="only this agent's Gaussians (default: all agents')")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Download the map. Returns the exit code. Raises MismatchError before the first refinement, UnavailableError."""
    prepare_file(options.out, MAP_FILE)
    with fusion_client(options) as client:
        data = client.export(Export(options.strategy, options.agent))
    write_atomic(options.out, data)
    print(f"wrote {options.out}, {len(data)} bytes")
    return 0
