"""`gausslite end`: end the mission of a running agent."""

from __future__ import annotations

import argparse

from gausslite.cli.team_options import add_address, agent_client
from gausslite.config.command_parser import bounded

_MAX_DRAIN_S = 86_400.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite end`."""
    add_address(parser, "the agent")
    parser.add_argument(
        "--handover",
        action="store_true",
        help="also send the map outside the task's region (default: as the agent's option)",
    )
    parser.add_argument(
        "--drain-timeout",
        metavar="S",
        type=bounded(float, 0, _MAX_DRAIN_S),
        help="longest time for sending, in seconds (default: the agent's)",
    )
    parser.set_defaults(run=run, handover=None)


def run(options: argparse.Namespace) -> int:
    """End the mission and print what was sent and left. Returns 0 if nothing was left, 1 otherwise.

    Raises MismatchError before the first task, UnavailableError.
    """
    with agent_client(options) as client:
        response = client.end_mission(options.handover, options.drain_timeout)
    print(response.summary)
    return 1 if response.voxels_waiting or response.keyframes_waiting else 0
