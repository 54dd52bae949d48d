"""`gausslite unban`: let an agent join a fusion server again that an operator has banned."""

from __future__ import annotations

import argparse

from gausslite.cli.team_options import add_address, fusion_client
from gausslite.domain.names import require_identifier


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite unban`."""
    add_address(parser, "the fusion server")
    parser.add_argument("agent", metavar="AGENT", help="id of the banned agent, as `gausslite status` prints it")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Lift the ban. Returns the exit code.

    Raises InvalidInputError if the agent is not banned, NotPermittedError unless the caller is an operator,
    UnavailableError.
    """
    require_identifier("AGENT", options.agent)
    with fusion_client(options) as client:
        client.unban(options.agent)
    print(f"{options.agent} may join again")
    return 0
