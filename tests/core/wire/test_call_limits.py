"""One caller cannot take a whole server: open calls, bandwidth and connections are limited."""

import asyncio
import contextlib
import socket
import weakref
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest
from certificates import identity, make_certificates
from fusion_running import GRID, fusion_server
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving import serving

from gausslite.domain.errors import InvalidInputError, RateLimitError
from gausslite.wire.call_limits import MESSAGE_BYTES, CallLimits, CallUsage, TokenBucket, wait_for_bandwidth
from gausslite.wire.clients import FusionClient, ParserClient
from gausslite.wire.security import Caller
from gausslite_language.rules import RuleParser
from gausslite_parser.program import parser_service

SERVING = health_pb2.HealthCheckResponse.SERVING
ROBOT = Caller("10.0.0.7")
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\x04" + bytes(5)


def connections(address: str, count: int) -> Iterator[socket.socket]:
    host, _, port = address.rpartition(":")
    for _ in range(count):
        connection = socket.create_connection((host, int(port)), 10)
        connection.sendall(PREFACE)
        yield connection


def is_closed(connection: socket.socket) -> bool:
    """Read until the server closes the connection, or has sent its settings and waits."""
    connection.settimeout(0.5)
    try:
        while connection.recv(4096):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        return True
    return True


def test_the_open_calls_of_a_caller_are_limited() -> None:
    usage = CallUsage(CallLimits(calls=2))
    with usage.open_call(ROBOT), usage.open_call(ROBOT):
        with pytest.raises(RateLimitError, match=r"expected at most 2 open ones from 10\.0\.0\.7") as refused:
            usage.open_call(ROBOT).__enter__()
        assert refused.value.retry_after_s == 5
        with usage.open_call(Caller("10.0.0.8")):
            pass
        with usage.open_call(Caller("10.0.0.7", frozenset({"husky-1"}))):
            pass
    with usage.open_call(ROBOT), usage.open_call(ROBOT):
        pass


def test_callers_that_are_gone_take_no_memory() -> None:
    usage, buckets = CallUsage(CallLimits()), []
    for number in range(1000):
        with usage.open_call(Caller(f"10.0.{number // 256}.{number % 256}")) as bandwidth:
            buckets.append(weakref.ref(bandwidth))
    assert sum(bucket() is not None for bucket in buckets) == 1


def test_requests_above_the_bandwidth_wait() -> None:
    async def send() -> float:
        loop = asyncio.get_running_loop()
        # one second's worth is free
        bandwidth, start_s = TokenBucket(8 * 100), loop.time()
        await wait_for_bandwidth(bandwidth, 100_000 - MESSAGE_BYTES)
        for _ in range(10):
            await wait_for_bandwidth(bandwidth, 1)
        return loop.time() - start_s

    elapsed_s = asyncio.run(send())
    assert elapsed_s >= 0.9 * 10 * MESSAGE_BYTES / 100_000


def test_a_certificate_has_its_own_limit_and_the_others_go_on(tmp_path: Path) -> None:
    certs = make_certificates(tmp_path, "server:none", "husky-1", "control:operator")
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as greedy,
        FusionClient(fusion.client.address, tls=identity(certs, "control")) as operator,
    ):
        watches = [greedy.watch() for _ in range(CallLimits().calls)]
        for watch in watches[: CallLimits().calls]:
            next(watch)
        with FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as again:
            pytest.raises(RateLimitError, again.join, "husky-1", GRID).match("open ones from husky-1")
        assert operator.status().fused_gaussians == 0
        for watch in watches:
            watch.close()


def fill_until_refused(address: str, count: int) -> list[socket.socket]:
    """Open connections until the server refuses the newest one."""
    opened = list(connections(address, count))
    opened[-1].settimeout(20)
    with contextlib.suppress(ConnectionError):
        while opened[-1].recv(4096):
            pass
    return opened


def test_connections_are_limited() -> None:
    with serving([parser_service(RuleParser())], "127.0.0.1:0", limits=CallLimits(connections=5)) as server:
        opened = list(connections(server.address, 20))
        assert sum(not is_closed(connection) for connection in opened) <= 5
        for connection in opened:
            connection.close()
        with ParserClient(server.address) as client:
            assert client.parse("Pick up the mug").targets == ("mug",)


def test_idle_connections_do_not_lock_out_who_is_connected_already() -> None:
    with serving([parser_service(RuleParser())], "127.0.0.1:0", limits=CallLimits(connections=5)) as server:
        with grpc.insecure_channel(server.address) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            assert check(health_pb2.HealthCheckRequest(), timeout=20, wait_for_ready=True).status == SERVING
            opened = fill_until_refused(server.address, 20)
            assert check(health_pb2.HealthCheckRequest(), timeout=20).status == SERVING
        for connection in opened:
            connection.close()
        with grpc.insecure_channel(server.address) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            assert check(health_pb2.HealthCheckRequest(), timeout=20, wait_for_ready=True).status == SERVING


def test_an_own_address_for_health_answers_while_idle_connections_take_the_other() -> None:
    limits = CallLimits(connections=200)
    with serving([parser_service(RuleParser())], "127.0.0.1:0", limits=limits, health_listen="127.0.0.1:0") as server:
        opened = fill_until_refused(server.address, 300)
        with grpc.insecure_channel(server.health_address) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            for name in ("", "liveness", "gausslite.v1.ParserService"):
                assert check(health_pb2.HealthCheckRequest(service=name), timeout=20).status == SERVING
            parse = channel.unary_unary("/gausslite.v1.ParserService/ParseTask")
            with pytest.raises(grpc.RpcError) as refused:
                parse(b"", timeout=20)
            assert refused.value.code() is grpc.StatusCode.UNIMPLEMENTED
        for connection in opened:
            connection.close()


def test_a_connection_without_a_call_is_closed() -> None:
    with serving([parser_service(RuleParser())], "127.0.0.1:0", limits=CallLimits(idle_s=1)) as server:
        (connection,) = connections(server.address, 1)
        connection.settimeout(20)
        received = b""
        while data := connection.recv(4096):
            received += data
        connection.close()
        # GOAWAY, a frame of type 7
        assert b"\x07\x00\x00\x00\x00\x00" in received
        with grpc.insecure_channel(server.address) as channel:
            grpc.channel_ready_future(channel).result(10)


def test_limits_are_at_least_one() -> None:
    pytest.raises(InvalidInputError, CallLimits, connections=0).match("connections: expected at least 1, got 0")
