"""The parser service in process: graphs, status codes, health, reflection, and an address in use."""

import asyncio
from pathlib import Path

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from other_process import run_python
from serving import serving

from gausslite.domain.errors import GaussLiteError, InvalidInputError, TaskError, UnavailableError
from gausslite.domain.task import TaskGraph
from gausslite.wire.clients import ParserClient
from gausslite.wire.server import start_server
from gausslite_language.rules import RuleParser
from gausslite_parser.program import parser_service


class FailingParser:
    """A parser with a bug."""

    def parse(self, text: str) -> TaskGraph:
        raise ZeroDivisionError("secret detail")


def test_the_client_returns_the_parsers_graph() -> None:
    text = "Identify the chair closest to the table"
    with serving([parser_service(RuleParser())]) as server, ParserClient(server.address) as client:
        assert client.parse(text) == RuleParser().parse(text)


def test_unix_socket(tmp_path: Path) -> None:
    listen = f"unix:{tmp_path}/parser.sock"
    with serving([parser_service(RuleParser())], listen) as server, ParserClient(server.address) as client:
        assert client.parse("Pick up the mug on the table").targets == ("mug",)
        pytest.raises(UnavailableError, asyncio.run, start_server(listen, [])).match("another server listens")


@pytest.mark.parametrize("text", ["", "   ", "x" * 100_000])
def test_an_invalid_task_is_a_task_error(text: str) -> None:
    with serving([parser_service(RuleParser())]) as server, ParserClient(server.address) as client:
        pytest.raises(TaskError, client.parse, text)
        assert client.parse("Pick up the mug").targets == ("mug",)


def test_an_unexpected_error_is_internal_without_details_and_the_server_keeps_serving() -> None:
    with serving([parser_service(FailingParser())]) as server, ParserClient(server.address) as client:
        for _ in range(2):
            with pytest.raises(GaussLiteError, match="unexpected error") as caught:
                client.parse("Pick up the mug")
            assert "secret" not in str(caught.value)


def test_invalid_message_bytes_are_an_invalid_argument() -> None:
    with serving([parser_service(RuleParser())]) as server, grpc.insecure_channel(server.address) as channel:
        call = channel.unary_unary("/gausslite.v1.ParserService/ParseTask")
        with pytest.raises(grpc.RpcError) as raised:
            call(b"\xff\xff\xff", timeout=20)
        assert raised.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert "3 invalid bytes" in raised.value.details()


def test_health_and_reflection() -> None:
    with serving([parser_service(RuleParser())]) as server, grpc.insecure_channel(server.address) as channel:
        check = health_pb2_grpc.HealthStub(channel).Check
        for name in ("", "gausslite.v1.ParserService"):
            assert check(health_pb2.HealthCheckRequest(service=name)).status == health_pb2.HealthCheckResponse.SERVING
        request = reflection_pb2.ServerReflectionRequest(list_services="")
        [answer] = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(iter([request]))
        names = {service.name for service in answer.list_services_response.service}
        assert names >= {"gausslite.v1.ParserService", "grpc.health.v1.Health"}


def test_an_address_in_use_is_one_line_and_code_2() -> None:
    with serving([parser_service(RuleParser())], "127.0.0.1:0") as server:
        pytest.raises(UnavailableError, asyncio.run, start_server(server.address, [])).match("in use")
        ended = run_python("-m", "gausslite_parser", "--listen", server.address)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert len(ended.stderr.splitlines()) == 1
    assert "in use" in ended.stderr


@pytest.mark.parametrize("listen", ["nowhere", "localhost:port", "localhost:70000", ":50051", "", "h:" + "9" * 5000])
def test_an_invalid_address_is_refused(listen: str) -> None:
    pytest.raises(InvalidInputError, asyncio.run, start_server(listen, [])).match("HOST:PORT")


@pytest.mark.slow
def test_an_impossible_socket_is_one_line_and_code_2(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("mine")
    sockets = {
        "1 to 107 bytes": ("", "/tmp/" + "x" * 200),
        "folder": (str(tmp_path / "nowhere" / "x.sock"),),
        "with this name exists": (str(tmp_path / "notes"),),
    }
    for reason, paths in sockets.items():
        for path in paths:
            ended = run_python("-m", "gausslite_parser", "--listen", f"unix:{path}")
            assert ended.returncode == 2
            [line] = ended.stderr.splitlines()
            assert reason in line
    assert (tmp_path / "notes").read_text() == "mine"


@pytest.mark.parametrize("address", ["127.0.0.1:1", "unix:/nowhere/parser.sock"])
def test_an_address_without_a_service_is_connection_refused(address: str) -> None:
    with ParserClient(address, deadline_s=5.0) as client:
        pytest.raises(UnavailableError, client.parse, "Pick up the mug").match(r"^parser .*: connection refused$")


def test_the_health_check_of_a_container(capsys: pytest.CaptureFixture[str]) -> None:
    from gausslite.cli.health_check import main

    with serving([parser_service(RuleParser())]) as server:
        assert main([server.address]) == 0
        assert main([server.address, "liveness"]) == 0
        assert main([server.address, "other"]) == 1
    assert main([server.address]) == 1
    with pytest.raises(SystemExit) as usage_error:
        main([])
    assert usage_error.value.code == 2
    *refusals, usage = capsys.readouterr().err.splitlines()
    assert [server.address in line for line in refusals] == [True, True]
    assert "the following arguments are required: HOST:PORT|unix:PATH" in usage
