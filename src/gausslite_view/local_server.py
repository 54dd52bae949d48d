"""A viser server that only this machine and only its own page can use; import it where a page is chosen."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from typing import Any
from urllib.parse import urlsplit

import viser

from gausslite.domain.errors import InvalidInputError

LOOPBACK = "127.0.0.1"
_LOOPBACK_NAMES = ("localhost", LOOPBACK, "::1")


class LocalServer(viser.ViserServer):
    """Serves the page on the loopback interface. Raises InvalidInputError if the port is in use."""

    def __init__(self, port: int, title: str) -> None:
        """port: 0 chooses a free one."""
        # one line for each connection says nothing to an operator
        logging.getLogger("websockets.server").setLevel(logging.WARNING)
        with _without_output():
            super().__init__(host=LOOPBACK, port=_require_free(port), label=title, verbose=False)
        # before viser's own callback, so that a refused connection gets nothing
        self._websock_server._client_connect_cb.insert(0, self._refuse_other_sites)
        self.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        self.gui.main_panel.dock_right()

    def stop(self) -> None:
        """Stop serving."""
        with _without_output():
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Return None: any client could ask for a tunnel to a public server."""
        return None

    def _refuse_other_sites(self, connection: Any) -> None:
        """Raise ConnectionRefusedError for the WebSocket of a page of another site, which browsers allow."""
        connections = self._websock_server._live_connections
        request = connections[connection.client_id].request
        headers = {} if request is None else request.headers
        if not is_own_page(headers.get("Host", ""), headers.get("Origin")):
            del connections[connection.client_id], self._websock_server._client_state_from_id[connection.client_id]
            raise ConnectionRefusedError("the page of another site asked for the view")


def _without_output() -> contextlib.redirect_stdout[io.StringIO]:
    # viser prints its addresses and its end, also with verbose=False
    return contextlib.redirect_stdout(io.StringIO())


def is_own_page(host: str, origin: str | None) -> bool:
    """Return True if a request for `host` comes from the page itself, or from a program, which sends no origin.

    The host must be a loopback name, or a foreign name that resolves to this machine would pass.
    """
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        return False
    return name in _LOOPBACK_NAMES and origin in (None, f"http://{host}")


def _require_free(port: int) -> int:
    """Return the port, a free one for 0: viser would silently take the next one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise InvalidInputError(
                f"view: expected a free port, got {port} ({error.strerror}); choose another"
            ) from error
        return int(probe.getsockname()[1])
