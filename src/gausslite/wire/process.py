"""Run a service as a process: one-line logs on stderr, exit code 2 for errors that the operator can fix."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Awaitable, Callable

from gausslite.domain.errors import GaussLiteError
from gausslite.process.messages import print_message, printable


class _OneLine(logging.Formatter):
    """Format a record, with its traceback, as one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Join the lines of the formatted record."""
        return " | ".join(printable(line) for line in super().format(record).splitlines())


def log_to_stderr(program: str) -> None:
    """Log records of level INFO and higher to stderr as `time program level message`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine(f"%(asctime)s {program} %(levelname)s %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def run_service(program: str, serve: Callable[[], Awaitable[None]]) -> int:
    """Run the service; returns 0 after a clean end, 2 with one line on stderr after a GaussLiteError."""
    log_to_stderr(program)

    async def body() -> None:
        await serve()

    try:
        asyncio.run(body())
    except GaussLiteError as error:
        print_message(f"{program}: {error}")
        return 2
    return 0
