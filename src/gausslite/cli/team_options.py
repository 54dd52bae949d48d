"""Options of the commands that reach a running service: its address and this caller's certificate."""

from __future__ import annotations

import argparse

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.wire.address import require_callable
from gausslite.wire.clients import AgentClient, FusionClient
from gausslite.wire.tls import TlsFiles


def add_address(parser: CommandParser, service: str) -> None:
    """Add ADDRESS and the options of encrypted connections."""
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH", help=f"address of {service}")
    add_flags(parser, TlsFiles)


def add_json(parser: CommandParser) -> None:
    """Add --json."""
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")


def fusion_client(options: argparse.Namespace) -> FusionClient:
    """Return a client of the fusion server at the address. Raises InvalidInputError."""
    require_callable("address of the fusion server", options.address)
    return FusionClient(options.address, tls=build(TlsFiles, options).read())


def agent_client(options: argparse.Namespace) -> AgentClient:
    """Return a client of the agent at the address. Raises InvalidInputError."""
    require_callable("address of the agent", options.address)
    return AgentClient(options.address, tls=build(TlsFiles, options).read())
