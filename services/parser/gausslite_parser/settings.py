"""The parser service's command line, read once."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

DEFAULT_LISTEN = "127.0.0.1:50051"


@dataclass(frozen=True, slots=True)
class ParserSettings:
    """Where to listen: HOST:PORT (port 0 = any free one) or unix:PATH."""

    listen: str = DEFAULT_LISTEN


def parse_arguments(arguments: Sequence[str] | None = None) -> ParserSettings:
    """Settings from the command line; ends the process with code 2 on a wrong option."""
    parser = argparse.ArgumentParser(
        prog="gausslite-parser", description="Serve gausslite.v1.ParserService: task text in, task graph out."
    )
    parser.add_argument(
        "--listen",
        default=DEFAULT_LISTEN,
        metavar="ADDRESS",
        help="HOST:PORT (port 0 = any free one) or unix:PATH; default %(default)s",
    )
    return ParserSettings(parser.parse_args(arguments).listen)
