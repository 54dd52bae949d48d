"""Serve a task parser until the process is stopped: settings, servicer, program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option, options_of
from gausslite.config.program import Program, parse_options
from gausslite.config.task_parser import ParserBackend, chosen_parser, parser_options
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.task import TaskParser
from gausslite.process import print_message
from gausslite.v1 import parser_service_pb2, parser_service_pb2_grpc
from gausslite.wire.channel import PARSER_ADDRESS
from gausslite.wire.convert_task import graph_to_message
from gausslite.wire.run_service import run_service
from gausslite.wire.security import Tls, TlsFiles
from gausslite.wire.server import Service, serve_until_stopped
from gausslite.wire.worker_pool import WorkerPool

_WORKERS = 2  # a language model that is slow to answer one caller leaves a thread for others
SERVICE_NAME = parser_service_pb2.DESCRIPTOR.services_by_name["ParserService"].full_name


class ParserServicer(parser_service_pb2_grpc.ParserServiceServicer):
    """Stateless; the parser runs on other threads, because it may be slow."""

    def __init__(self, parser: TaskParser) -> None:
        self._parser, self._workers = parser, WorkerPool("parser", _WORKERS)

    async def ParseTask(  # noqa: N802 (gRPC's name)
        self, request: parser_service_pb2.ParseTaskRequest, context: Any
    ) -> parser_service_pb2.ParseTaskResponse:
        """Return the graph of one task; a TaskError becomes INVALID_ARGUMENT TASK."""
        graph = await self._workers.run(context, self._parser.parse, request.text)
        return parser_service_pb2.ParseTaskResponse(graph=graph_to_message(graph))


def parser_service(parser: TaskParser) -> Service:
    """Return the service of this parser for a gRPC server."""
    add = parser_service_pb2_grpc.add_ParserServiceServicer_to_server
    return Service(SERVICE_NAME, partial(add, ParserServicer(parser)))


@dataclass(frozen=True, slots=True)
class ParserSettings:
    """Address of the service, and the parser."""

    backend: ParserBackend
    listen: str = option(PARSER_ADDRESS, "HOST:PORT (port 0: any free one) or unix:PATH", metavar="ADDRESS")
    tls: Tls | None = None


def parse_arguments(arguments: Sequence[str] | None = None) -> ParserSettings:
    """Return the settings of the options. Ends the process with code 2 for wrong flags. Raises InvalidInputError."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    tls = build(TlsFiles, options).read_for_server()
    return build(ParserSettings, options, backend=chosen_parser(options), tls=tls)


def build_parser() -> CommandParser:
    """Return the parser of `gausslite-parser`."""
    parser = CommandParser(
        prog="gausslite-parser", description="Serve gausslite.v1.ParserService: parse task texts into task graphs."
    )
    settings = (ParserSettings, *parser_options(), TlsFiles)
    Program.of(
        *settings,
        flags=" ".join(key for of in settings for key in options_of(of)),
    ).add_to(parser)
    return parser


def run(arguments: Sequence[str] | None = None) -> int:
    """Return 0 after a clean end, 2 with one line on stderr if the service cannot start."""
    try:
        settings = parse_arguments(arguments)
        parser = settings.backend.open()
    except GaussLiteError as error:
        print_message(f"gausslite-parser: {error}")
        return 2

    async def serve() -> int:
        await serve_until_stopped(settings.listen, [parser_service(parser)], tls=settings.tls)
        return 0

    return run_service("gausslite-parser", serve)
