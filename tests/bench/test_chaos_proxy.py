"""The proxy of the chaos run: it forwards, resets, and holds back what an agent sends."""

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gausslite_bench.chaos.fault_proxy import FaultProxy

WAIT_S = 20.0


def echo(listener: socket.socket) -> None:
    """Send back what one connection after the other receives, until the listener is closed."""
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        with connection:
            while data := connection.recv(100):
                connection.sendall(data)


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[FaultProxy]:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "echo"))
        listener.listen()
        threading.Thread(target=echo, args=(listener,), daemon=True).start()
        faulty = FaultProxy(tmp_path, ["ant", "bee"], tmp_path / "echo")
        yield faulty
        faulty.close()
        listener.shutdown(socket.SHUT_RDWR)


def connect(proxy: FaultProxy, agent_id: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(WAIT_S)
    connection.connect(proxy.address(agent_id).removeprefix("unix:"))
    return connection


def test_a_stalled_connection_gets_everything_when_it_is_healed(proxy: FaultProxy) -> None:
    with connect(proxy, "ant") as ant:
        ant.sendall(b"1")
        assert ant.recv(1) == b"1"
        proxy.set_fault("ant", is_stalled=True)
        ant.sendall(b"2")
        ant.settimeout(0.2)
        pytest.raises(TimeoutError, ant.recv, 1)
        proxy.set_fault("ant")
        ant.settimeout(WAIT_S)
        assert ant.recv(1) == b"2"


def test_a_cut_connection_is_reset_and_the_others_stay(proxy: FaultProxy) -> None:
    with connect(proxy, "ant") as ant, connect(proxy, "bee") as bee:
        ant.sendall(b"1")
        assert ant.recv(1) == b"1"
        proxy.set_fault("ant", is_cut=True)
        assert ant.recv(1) == b""
        bee.sendall(b"3")
        assert bee.recv(1) == b"3"
    with connect(proxy, "ant") as refused:
        assert refused.recv(1) == b""
    proxy.set_fault("ant")
    with connect(proxy, "ant") as again:
        again.sendall(b"4")
        assert again.recv(1) == b"4"
