"""Traces: an agent's calls and the server's work on them arrive at a collector as one trace."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import grpc
import pytest
from fusion_running import GRID, make_subset, request, server_process

from gausslite.domain.errors import InvalidInputError, SessionUnknownError
from gausslite.wire.clients import FusionClient
from gausslite.wire.tracing import tracing

pytest.importorskip("opentelemetry.exporter.otlp.proto.grpc", reason="the extra otel is not installed")

from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as pb
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2_grpc as pb_grpc

_CLIENT, _SERVER = 3, 2


class Collector(pb_grpc.TraceServiceServicer):
    """Keeps the spans of all programs, as (program, span)."""

    def __init__(self) -> None:
        self.spans: list[tuple[str, Any]] = []
        self._arrived = threading.Condition()

    def Export(self, request: Any, context: Any) -> Any:
        with self._arrived:
            for resource in request.resource_spans:
                [name] = [
                    each.value.string_value for each in resource.resource.attributes if each.key == "service.name"
                ]
                self.spans += [(name, span) for scope in resource.scope_spans for span in scope.spans]
            self._arrived.notify_all()
        return pb.ExportTraceServiceResponse()


@contextmanager
def collector() -> Iterator[tuple[Collector, str]]:
    servicer, server = Collector(), grpc.server(ThreadPoolExecutor(2))
    pb_grpc.add_TraceServiceServicer_to_server(servicer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield servicer, f"127.0.0.1:{port}"
    finally:
        server.stop(None)


def test_a_contribution_is_one_trace_from_the_client_to_the_commit() -> None:
    with collector() as (collected, address):
        with server_process("--traces", address) as (process, plain), tracing(address, "robot"):
            with FusionClient(plain.address) as client:
                session = client.join("ant", GRID).session_id
                [_] = client.contribute([request(session, make_subset("ant", 1, {0: [4], 1: [2, 2]}))], 20.0)
                with pytest.raises(SessionUnknownError):
                    client.keep_session("nobody")
            process.terminate()
            assert process.wait(20) == 0
        spans = {(program, span.name.rpartition("/")[2], span.kind): span for program, span in collected.spans}
    called = spans["robot", "ContributeSubsets", _CLIENT]
    served = spans["gausslite-fusion-server", "ContributeSubsets", _SERVER]
    [stored] = [span for (_, name, _), span in spans.items() if name == "contribution"]
    assert called.trace_id == served.trace_id == stored.trace_id
    assert served.parent_span_id == called.span_id
    assert stored.parent_span_id == served.span_id
    values = {each.key: each.value for each in stored.attributes}
    assert (values["agent"].string_value, values["voxels"].int_value) == ("ant", 2)
    assert [event.name for event in stored.events] == ["decoded"]
    refused = spans["gausslite-fusion-server", "KeepSession", _SERVER]
    assert (refused.status.code, refused.status.message) == (2, "SessionUnknownError")
    assert spans["robot", "KeepSession", _CLIENT].status.code == 2


def test_without_a_collector_calls_work_and_a_wrong_address_is_one_line() -> None:
    with server_process("--traces", "127.0.0.1:9") as (_, client):
        assert client.join("ant", GRID).session_id
    with pytest.raises(InvalidInputError, match="--traces: expected HOST:PORT"), tracing("nowhere", "robot"):
        pass
