"""Run a service as a process: one-line logs on stderr, exit code 2 for errors that the operator can fix."""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from gausslite.domain.errors import GaussLiteError
from gausslite.plugins import absent_package
from gausslite.process import print_message, printable

_SWITCH_INTERVAL_S = 0.001  # Python's 5 ms would delay the event loop behind each thread that computes


class LogFormat(StrEnum):
    """How a service writes its log."""

    TEXT = "text"
    JSON = "json"


class _OneLine(logging.Formatter):
    """Format a record, with its traceback, as one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Join the lines of the formatted record."""
        return " | ".join(printable(line) for line in super().format(record).splitlines())


class _JsonLine(logging.Formatter):
    """Format a record as one JSON object; JSON escapes control characters."""

    def __init__(self, program: str) -> None:
        super().__init__()
        self._program = program

    def format(self, record: logging.LogRecord) -> str:
        """Return time (UTC, ISO 8601), program, level, logger and message, and a traceback as `error`."""
        values = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "program": self._program,
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            values["error"] = self.formatException(record.exc_info)
        return json.dumps(values)


def log_to_stderr(program: str, log_format: LogFormat = LogFormat.TEXT) -> None:
    """Log records of level INFO and higher to stderr: `time program level message`, or a JSON object a line."""
    handler = logging.StreamHandler(sys.stderr)
    text = _OneLine(f"%(asctime)s {program} %(levelname)s %(message)s")
    handler.setFormatter(text if log_format is LogFormat.TEXT else _JsonLine(program))
    # JSON replaces the text that a service starts with
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=log_format is LogFormat.JSON)


def run_service(program: str, serve: Callable[[], Coroutine[Any, Any, int]]) -> int:
    """Run the service and return its exit code; 2 with one line on stderr after a GaussLiteError."""
    log_to_stderr(program)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        return asyncio.run(serve())
    except GaussLiteError as error:
        print_message(f"{program}: {error}")
        return 2
    except ModuleNotFoundError as error:
        if (package := absent_package(error)) is None:
            raise
        print_message(f"{program}: needs the package {package}, which is not installed")
        return 2
