"""Serve a task parser until the process is stopped: settings, servicer, program."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.program import Program, parse_options
from gausslite.domain.errors import GaussLiteError
from gausslite.process import print_message
from gausslite.v1 import parser_service_pb2, parser_service_pb2_grpc
from gausslite.wire.channel import PARSER_ADDRESS
from gausslite.wire.convert_task import graph_to_message
from gausslite.wire.process import run_service
from gausslite.wire.security import Tls, TlsFiles
from gausslite.wire.server import Service, serve_until_stopped
from gausslite_language.grounding import TaskParser
from gausslite_language.rules import BackendSettings, open_parser

SERVICE_NAME = parser_service_pb2.DESCRIPTOR.services_by_name["ParserService"].full_name


class ParserServicer(parser_service_pb2_grpc.ParserServiceServicer):
    """Stateless; the parser runs on another thread, because it may be slow."""

    def __init__(self, parser: TaskParser) -> None:
        self._parser = parser

    async def ParseTask(  # noqa: N802 (gRPC's name)
        self, request: parser_service_pb2.ParseTaskRequest, _context: Any
    ) -> parser_service_pb2.ParseTaskResponse:
        """Return the graph of one task; a TaskError becomes INVALID_ARGUMENT TASK."""
        graph = await asyncio.to_thread(self._parser.parse, request.text)
        return parser_service_pb2.ParseTaskResponse(graph=graph_to_message(graph))


def parser_service(parser: TaskParser) -> Service:
    """Return the service of this parser for a gRPC server."""
    servicer = ParserServicer(parser)
    return Service(
        SERVICE_NAME, lambda server: parser_service_pb2_grpc.add_ParserServiceServicer_to_server(servicer, server)
    )


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
