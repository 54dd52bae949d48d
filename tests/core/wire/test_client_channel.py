"""Clients after `close`, and the threads that a failed stream leaves."""

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from serving import serving

from gausslite.domain.camera import Camera
from gausslite.domain.errors import UnavailableError
from gausslite.domain.frame import Frame
from gausslite.wire.channel import is_local, require_serving
from gausslite.wire.clients import AgentClient, FusionClient

NOBODY = "127.0.0.1:1"
CAMERA = Camera(50.0, 50.0, 40.0, 30.0, 80, 60)
FRAME = Frame(0, 0, np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32), CAMERA, np.eye(4))


@pytest.mark.parametrize(
    "call",
    [
        lambda agent, _: agent.status(),
        lambda agent, _: list(agent.ingest([FRAME])),
        lambda agent, _: next(agent.watch_map()),
        lambda _, fusion: fusion.query_objects("mug"),
        lambda _, fusion: next(fusion.watch()),
    ],
)
def test_a_closed_client_says_so(call: Callable[[AgentClient, FusionClient], object]) -> None:
    agent, fusion = AgentClient(NOBODY), FusionClient(NOBODY)
    for client in (agent, fusion):
        client.close()
        client.close()
    pytest.raises(UnavailableError, call, agent, fusion).match("expected an open client, got one that was closed")


def test_no_thread_reads_frames_after_a_failed_stream() -> None:
    readers = []

    def frames() -> Iterator[Frame]:
        readers.append(threading.current_thread())
        yield FRAME

    with AgentClient(NOBODY) as agent, pytest.raises(UnavailableError):
        list(agent.ingest(frames()))
    assert len(readers) == 1
    assert not readers[0].is_alive()


@pytest.mark.parametrize("variable", ["http_proxy", "https_proxy", "grpc_proxy"])
def test_a_service_of_this_machine_is_reached_without_the_proxy(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, f"http://{NOBODY}")
    with serving([], "127.0.0.1:0") as server:
        port = server.address.rpartition(":")[2]
        for host in ("127.0.0.1", "localhost"):
            require_serving(f"{host}:{port}", None)


def test_an_error_through_a_proxy_names_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", f"http://{NOBODY}")
    with pytest.raises(UnavailableError, match="the variable http_proxy states a proxy"):
        require_serving("robots.example.org:50052", None)
    pytest.raises(UnavailableError, require_serving, NOBODY, None).match(f"^{NOBODY}: connection refused$")


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        *((address, True) for address in ("127.0.0.1:1", "[::1]:1", "10.0.0.7:1", "192.168.1.2:1", "169.254.3.4:1")),
        *((address, True) for address in ("localhost:1", "fusion:50052", "husky.local:1", "unix:/tmp/a.sock")),
        *((address, False) for address in ("8.8.8.8:1", "robots.example.org:1", "[2001:4860:4860::8888]:1")),
    ],
)
def test_only_addresses_outside_this_network_use_a_proxy(address: str, expected: bool) -> None:
    assert is_local(address) == expected
