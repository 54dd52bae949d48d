"""Serve a task parser until the process is stopped."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.errors import GaussLiteError
from gausslite.process.messages import print_message
from gausslite.task.backends import open_parser
from gausslite.wire.process import run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_parser.servicer import parser_service
from gausslite_parser.settings import parse_arguments


def run(arguments: Sequence[str] | None = None) -> int:
    """Return 0 after a clean end, 2 with one line on stderr if the service cannot start."""
    try:
        settings = parse_arguments(arguments)
        parser = open_parser(settings.backend)
    except GaussLiteError as error:
        print_message(f"gausslite-parser: {error}")
        return 2

    async def serve() -> int:
        await serve_until_stopped(settings.listen, [parser_service(parser)], tls=settings.tls)
        return 0

    return run_service("gausslite-parser", serve)
