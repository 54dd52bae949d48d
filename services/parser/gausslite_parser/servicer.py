"""ParseTask over any TaskParser: decode, call, encode."""

from __future__ import annotations

import asyncio
from typing import Any

from gausslite.task.parser import TaskParser
from gausslite.v1 import parser_service_pb2, parser_service_pb2_grpc
from gausslite.wire.convert_task import graph_to_message
from gausslite.wire.server import Service

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
