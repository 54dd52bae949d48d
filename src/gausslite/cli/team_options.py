"""Options of the commands that reach a running service: its address and this caller's certificate."""

from __future__ import annotations

import argparse

from gausslite.config.tls_options import add_tls, read_tls
from gausslite.wire.address import require_callable
from gausslite.wire.clients import AgentClient, FusionClient


def add_address(parser: argparse.ArgumentParser, service: str) -> None:
    """Add ADDRESS and the options of encrypted connections."""
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH", help=f"address of {service}")
    add_tls(parser)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add --json."""
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")


def fusion_client(options: argparse.Namespace) -> FusionClient:
    """Return a client of the fusion server at the address. Raises InvalidInputError."""
    require_callable("address of the fusion server", options.address)
    return FusionClient(options.address, tls=read_tls(options))


def agent_client(options: argparse.Namespace) -> AgentClient:
    """Return a client of the agent at the address. Raises InvalidInputError."""
    require_callable("address of the agent", options.address)
    return AgentClient(options.address, tls=read_tls(options))
