"""The parser service's command line, read once."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

from gausslite.config.layers import parse_options
from gausslite.config.task_parser_options import add_backend, backend_settings
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.task.backends import BackendSettings
from gausslite.wire.tls import Tls

DEFAULT_LISTEN = "127.0.0.1:50051"


@dataclass(frozen=True, slots=True)
class ParserSettings:
    """Where to listen, HOST:PORT (port 0 = any free one) or unix:PATH, and who reads the tasks."""

    listen: str = DEFAULT_LISTEN
    backend: BackendSettings = field(default_factory=BackendSettings)
    tls: Tls | None = None


def parse_arguments(arguments: Sequence[str] | None = None) -> ParserSettings:
    """Settings from the command line; ends the process with code 2 on a wrong option. Raises InvalidInputError."""
    parser = argparse.ArgumentParser(
        prog="gausslite-parser", description="Serve gausslite.v1.ParserService: task text in, task graph out."
    )
    parser.add_argument(
        "--listen",
        default=DEFAULT_LISTEN,
        metavar="ADDRESS",
        help="HOST:PORT (port 0 = any free one) or unix:PATH; default %(default)s",
    )
    add_backend(parser)
    add_tls(parser)
    options = parse_options(parser, arguments)
    return ParserSettings(options.listen, backend_settings(options, os.environ), read_server_tls(options))
