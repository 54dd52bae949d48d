"""The server of a page writes no line for each connection of a browser."""

import logging

import pytest

pytest.importorskip("viser", reason="the page needs the extra view")
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from gausslite_view.local_server import LocalServer


def test_a_connection_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    import viser

    server = LocalServer(0, "page")
    try:
        caplog.set_level(logging.INFO)
        address = f"localhost:{server.get_port()}"
        with connect(f"ws://{address}", subprotocols=[Subprotocol(f"viser-v{viser.__version__}")]) as connection:
            assert connection.recv(timeout=20)
    finally:
        server.stop()
    assert not [record for record in caplog.records if record.name.startswith("websockets.server")]
