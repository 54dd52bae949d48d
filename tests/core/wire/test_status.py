"""The table of errors and status codes: it contains every error, and clients raise the same class."""

import asyncio
import inspect
from typing import Any

import grpc
import pytest
from serving import serving

from gausslite.domain import errors
from gausslite.domain.errors import GaussLiteError, QuotaError, UnavailableError
from gausslite.domain.task import TaskGraph
from gausslite.v1 import parser_service_pb2, parser_service_pb2_grpc
from gausslite.wire.channel import MAX_MESSAGE_BYTES
from gausslite.wire.clients import ParserClient
from gausslite.wire.server import Service
from gausslite.wire.status import MAX_ERROR_CHARACTERS, code_and_reason, error_from_reason

ERRORS = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, GaussLiteError)]
CODES = {
    errors.InvalidInputError: grpc.StatusCode.INVALID_ARGUMENT,
    errors.CodecError: grpc.StatusCode.INVALID_ARGUMENT,
    errors.TaskError: grpc.StatusCode.INVALID_ARGUMENT,
    errors.SessionUnknownError: grpc.StatusCode.NOT_FOUND,
    errors.MismatchError: grpc.StatusCode.FAILED_PRECONDITION,
    errors.RevisionGoneError: grpc.StatusCode.OUT_OF_RANGE,
    errors.QuotaError: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.ChecksumError: grpc.StatusCode.DATA_LOSS,
    errors.NotPermittedError: grpc.StatusCode.PERMISSION_DENIED,
    errors.UnavailableError: grpc.StatusCode.UNAVAILABLE,
}


class FailingParser(parser_service_pb2_grpc.ParserServiceServicer):
    """A servicer that raises the error named by the request's text."""

    def __init__(self) -> None:
        self.calls = 0

    async def ParseTask(self, request: parser_service_pb2.ParseTaskRequest, context: Any) -> Any:
        self.calls += 1
        if request.text == "UNAUTHENTICATED":
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, "no certificate")
        if request.text.startswith("failed"):
            await context.abort(grpc.StatusCode.UNAVAILABLE, request.text)
        raise getattr(errors, request.text)("one line: expected a, got b")


def service(servicer: FailingParser) -> Service:
    return Service(
        "gausslite.v1.ParserService",
        lambda server: parser_service_pb2_grpc.add_ParserServiceServicer_to_server(servicer, server),
    )


def test_the_client_raises_what_the_server_raised() -> None:
    servicer = FailingParser()
    with serving([service(servicer)]) as server, ParserClient(server.address) as client:
        for kind in ERRORS:
            servicer.calls = 0
            with pytest.raises(GaussLiteError) as caught:
                client.parse(kind.__name__)
            assert type(caught.value) is kind
            assert str(caught.value) == "one line: expected a, got b"
            # only errors that ask for a retry are retried
            assert servicer.calls == (4 if kind is UnavailableError else 1), kind


def test_each_error_has_its_documented_code_and_a_unique_reason() -> None:
    assert {kind: code_and_reason(kind("x"))[0] for kind in CODES} == CODES
    reasons = [code_and_reason(kind("x"))[1] for kind in ERRORS]
    assert len(set(reasons)) == len(ERRORS)
    assert [type(error_from_reason(reason, "x")) for reason in reasons] == ERRORS
    assert type(error_from_reason("OF_ANOTHER_VERSION", "x")) is GaussLiteError


def test_a_status_without_our_details_gets_the_class_of_its_code() -> None:
    with serving([service(FailingParser())]) as server, ParserClient(server.address) as client:
        pytest.raises(errors.NotPermittedError, client.parse, "UNAUTHENTICATED").match("no certificate")
        pytest.raises(QuotaError, client.parse, "x" * (MAX_MESSAGE_BYTES + 1))


@pytest.mark.parametrize(
    ("cause", "meaning"),
    [
        ("Failed to connect to remote host: Connection refused", "connection refused"),
        ("Socket closed", "a server with certificates expects tls-cert, tls-key and tls-ca"),
        ("Tls handshake failed: OPENSSL_internal:CERTIFICATE_VERIFY_FAILED", "not from an authority in tls-ca"),
        ("Tls handshake failed: OPENSSL_internal:WRONG_VERSION_NUMBER", "no TLS there"),
    ],
)
def test_a_failed_connection_says_what_to_change(cause: str, meaning: str) -> None:
    text = f"failed to connect to all addresses; last error: UNKNOWN: ipv4:127.0.0.1:50051: {cause}"
    with serving([service(FailingParser())]) as server, ParserClient(server.address) as client:
        with pytest.raises(UnavailableError, match=f"^[^ ]+ [^ ]+: .*{meaning}") as raised:
            client.parse(text)
        assert "last error" not in str(raised.value)


def test_a_missed_deadline_is_unavailable() -> None:
    class Slow(parser_service_pb2_grpc.ParserServiceServicer):
        async def ParseTask(self, request: Any, context: Any) -> TaskGraph:
            await asyncio.Event().wait()
            raise AssertionError

    slow = Service(
        "gausslite.v1.ParserService",
        lambda server: parser_service_pb2_grpc.add_ParserServiceServicer_to_server(Slow(), server),
    )
    with serving([slow]) as server, ParserClient(server.address, deadline_s=0.2) as client:
        pytest.raises(UnavailableError, client.parse, "anything").match(rf"^parser {server.address}: no answer in time")


def test_a_request_is_small_and_so_is_the_error_that_quotes_it(caplog: pytest.LogCaptureFixture) -> None:
    class Quoting(parser_service_pb2_grpc.ParserServiceServicer):
        async def ParseTask(self, request: Any, context: Any) -> TaskGraph:
            raise errors.TaskError(f"task: expected less, got {request.text}")

    quoting = Service(
        "gausslite.v1.ParserService",
        lambda server: parser_service_pb2_grpc.add_ParserServiceServicer_to_server(Quoting(), server),
    )
    with serving([quoting]) as server, ParserClient(server.address) as client:
        with pytest.raises(errors.TaskError, match="task: expected less, got xxx") as quoted:
            client.parse("x" * 900_000)
        with pytest.raises(QuotaError, match="a request of at most 1048576 bytes, got 11"):
            client.parse("x" * 1_100_000)
    assert len(str(quoted.value)) <= MAX_ERROR_CHARACTERS
    assert all(len(record.getMessage()) < 2 * MAX_ERROR_CHARACTERS for record in caplog.records)
