"""Ask a service for its health, as containers do: `python -m gausslite.cli.health_check ADDRESS`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.process import print_message
from gausslite.wire.channel import require_serving
from gausslite.wire.security import TlsFiles


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0 if the service is SERVING, 1 with one line on stderr if not, 2 for wrong options."""
    parser = CommandParser(prog="python -m gausslite.cli.health_check")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    parser.add_argument("service", nargs="?", default="", help="liveness: only whether the process answers")
    add_flags(parser, TlsFiles)
    options = parser.parse_args(arguments)
    try:
        require_serving(options.address, build(TlsFiles, options).read(), options.service)
    except InvalidInputError as error:
        print_message(str(error))
        return 2
    except UnavailableError as error:
        print_message(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
