"""Settings of the parser service, read from its options."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

from gausslite.config.command_parser import CommandParser
from gausslite.config.default_addresses import PARSER_ADDRESS
from gausslite.config.layers import parse_options
from gausslite.config.task_parser_options import add_backend, backend_settings
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.process.messages import print_message
from gausslite.task.backends import BackendSettings
from gausslite.wire.tls import Tls


@dataclass(frozen=True, slots=True)
class ParserSettings:
    """Address of the service, HOST:PORT (port 0: any free one) or unix:PATH, and the backend that parses tasks."""

    listen: str = PARSER_ADDRESS
    backend: BackendSettings = field(default_factory=BackendSettings)
    tls: Tls | None = None


def parse_arguments(arguments: Sequence[str] | None = None) -> ParserSettings:
    """Return the settings of the options. Ends the process with code 2 for wrong flags. Raises InvalidInputError."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    return ParserSettings(options.listen, backend_settings(options, os.environ), read_server_tls(options))


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of `gausslite-parser`, without the options of configuration files."""
    parser = CommandParser(
        prog="gausslite-parser", description="Serve gausslite.v1.ParserService: parse task texts into task graphs."
    )
    parser.add_argument(
        "--listen",
        default=PARSER_ADDRESS,
        metavar="ADDRESS",
        help="HOST:PORT (port 0: any free one) or unix:PATH (default: %(default)s)",
    )
    add_backend(parser)
    add_tls(parser)
    return parser
