"""A page that follows a running service until it is closed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.process import import_extra
from gausslite.wire.channel import UNIX, host_and_port, require_callable
from gausslite.wire.clients import AgentClient, FusionClient
from gausslite.wire.security import Tls
from gausslite_objects.mapped_objects import open_memory
from gausslite_objects.object_memory import ObjectMemory
from gausslite_view.contents import DEFAULT_LIMIT

if TYPE_CHECKING:
    from gausslite_view.map_page import MapPage


def open_page(port: int, title: str, limit: int = DEFAULT_LIMIT) -> MapPage:
    """Serve a page on the loopback interface; port 0 chooses a free one.

    Raises InvalidInputError without the extra `view`, and for a port in use.
    """
    import_extra("viser", "view", "the view")
    from gausslite_view.map_page import MapPage

    return MapPage(port, title, limit)


_log = logging.getLogger(__name__)

_POLL_S = 1.0
_DEADLINE_S = 120.0
_ANY_HOST = ("0.0.0.0", "[::]")  # noqa: S104  (recognised, not bound)


@contextmanager
def live_page(
    port: int,
    address: str,
    is_agent: bool,
    tls: Tls | None = None,
    limit: int = DEFAULT_LIMIT,
) -> Iterator[str]:
    """Serve the page of an agent or a fusion server, also one that starts later; yield the page's URL.

    Raises InvalidInputError for an unusable address or port.
    """
    require_callable("view", address)
    page = open_page(port, f"GaussLite {'agent' if is_agent else 'fusion server'}", limit)
    stopped = threading.Event()

    def open_client() -> AgentClient | FusionClient:
        if is_agent:
            return AgentClient(address, _DEADLINE_S, tls)
        return FusionClient(address, _DEADLINE_S, tls=tls)

    memory = open_memory(address, tls)
    follower = threading.Thread(target=_follow, args=(page, open_client, memory, stopped), daemon=True)
    follower.start()
    try:
        yield page.url
    finally:
        stopped.set()
        follower.join(_POLL_S * 5)
        page.close()


@contextmanager
def service_page(port: int, listen: str, is_agent: bool, tls: Tls | None = None) -> Iterator[None]:
    """Serve the page of a service from its own process and log the page's URL. Raises InvalidInputError."""
    with live_page(port, own_address(listen), is_agent, tls) as url:
        _log.info("the page is at %s", url)
        yield


def own_address(listen: str) -> str:
    """Return the address at which a process reaches its own service. Raises InvalidInputError for port 0."""
    if listen.startswith(UNIX):
        return listen
    host, port = host_and_port("--listen", listen)
    if port == 0:
        raise InvalidInputError("view: expected a fixed port in --listen, got 0")
    return f"localhost:{port}" if host in _ANY_HOST else listen


def _follow(
    page: MapPage,
    open_client: Callable[[], AgentClient | FusionClient],
    memory: ObjectMemory,
    stopped: threading.Event,
) -> None:
    from gausslite_view.agent_panel import AgentPanel
    from gausslite_view.fusion_panel import FusionPanel

    client = open_client()
    panel: AgentPanel | FusionPanel
    panel = AgentPanel(page, client, memory) if isinstance(client, AgentClient) else FusionPanel(page, client, memory)
    poll: Callable[[], None] = panel.poll
    try:
        while not stopped.wait(_POLL_S):
            try:
                poll()
                page.show_problem("")
            except GaussLiteError as error:
                page.show_problem(str(error))
    finally:
        panel.close()
