"""Serve the rule-based parser until told to stop."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.task.rules import RuleParser
from gausslite.wire.process import run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_parser.servicer import parser_service
from gausslite_parser.settings import parse_arguments


def run(arguments: Sequence[str] | None = None) -> int:
    """0 after a clean end, 2 with one line on stderr when it cannot serve."""
    settings = parse_arguments(arguments)
    return run_service("gausslite-parser", lambda: serve_until_stopped(settings.listen, [parser_service(RuleParser())]))
