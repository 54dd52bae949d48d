"""Settings of the parser service, read from its options."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.program import Program, parse_options
from gausslite.process.messages import print_message
from gausslite.task.backends import BackendSettings
from gausslite.wire.address import PARSER_ADDRESS
from gausslite.wire.tls import Tls, TlsFiles


@dataclass(frozen=True, slots=True)
class ParserSettings:
    """Address of the service, and the backend that parses tasks."""

    listen: str = option(PARSER_ADDRESS, "HOST:PORT (port 0: any free one) or unix:PATH", metavar="ADDRESS")
    backend: BackendSettings = field(default_factory=BackendSettings)
    tls: Tls | None = None


PROGRAM = Program.of(
    *(ParserSettings, TlsFiles),
    flags="listen backend llm-model llm-url tls-cert tls-key tls-ca",
    removed={"traces": "the package opentelemetry-instrumentation-grpc traces calls"},
)


def parse_arguments(arguments: Sequence[str] | None = None) -> ParserSettings:
    """Return the settings of the options. Ends the process with code 2 for wrong flags. Raises InvalidInputError."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    key = os.environ.get(options.llm_key_variable) or None
    backend = build(BackendSettings, options, api_key=key)
    return build(ParserSettings, options, backend=backend, tls=build(TlsFiles, options).read_for_server())


def build_parser() -> CommandParser:
    """Return the parser of `gausslite-parser`."""
    parser = CommandParser(
        prog="gausslite-parser", description="Serve gausslite.v1.ParserService: parse task texts into task graphs."
    )
    PROGRAM.add_to(parser)
    return parser
