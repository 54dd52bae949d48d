"""Run a service as a process: logs to stderr one line each, a known end, exit code 2 for what the operator can mend."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Awaitable, Callable

from gausslite.errors import GaussLiteError


class _OneLine(logging.Formatter):
    """A record on one line, its traceback too, so that logs can be read by line."""

    def format(self, record: logging.LogRecord) -> str:
        """Fold whatever would have been several lines."""
        return " | ".join(super().format(record).splitlines())


def log_to_stderr(program: str) -> None:
    """Send every record from INFO up to stderr as `time program level message`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine(f"%(asctime)s {program} %(levelname)s %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def run_service(program: str, serve: Callable[[], Awaitable[None]]) -> int:
    """The exit code of a service: 0 after a clean end, 2 and one line on stderr for a deliberate error."""
    log_to_stderr(program)

    async def body() -> None:
        await serve()

    try:
        asyncio.run(body())
    except GaussLiteError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2
    return 0
