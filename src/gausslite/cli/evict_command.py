"""`gausslite evict`: delete the data of an agent from a fusion server, and keep it out on request."""

from __future__ import annotations

import argparse

from gausslite.cli.team_options import add_address, fusion_client
from gausslite.domain.names import require_identifier


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite evict`."""
    add_address(parser, "the fusion server")
    parser.add_argument("agent", metavar="AGENT", help="id of the agent, as `gausslite status` prints it")
    parser.add_argument("--ban", action="store_true", help="also refuse later joins under this id")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """End the agent's session, delete its data and print how much that was. Returns the exit code.

    Raises InvalidInputError for an unknown agent, NotPermittedError unless the caller is an operator, UnavailableError.
    """
    require_identifier("AGENT", options.agent)
    with fusion_client(options) as client:
        voxels = client.evict(options.agent, options.ban)
    print(f"{'banned' if options.ban else 'evicted'} {options.agent}: data of {voxels} voxels deleted")
    return 0
