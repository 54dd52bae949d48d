"""Servers in this process that share a mission in one PostgreSQL database."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from fusion_running import GRID
from waiting import wait_until

from gausslite.domain.errors import UnavailableError
from gausslite.fusion.limits import FusionSettings
from gausslite.wire.clients import FusionClient
from gausslite.wire.security import Tls
from gausslite.wire.server import start_server
from gausslite_cluster.shared_servicer import Share, open_share
from gausslite_fusion_server.settings import ServerSettings


@dataclass(frozen=True)
class SharingServer:
    """A running server. stop: ends it, so that its regions move to the others."""

    address: str
    share: Share
    client: FusionClient
    stop: Callable[[], None]


@contextmanager
def sharing_server(
    url: str, address: str, tls: Tls | None = None, client_tls: Tls | None = None
) -> Iterator[SharingServer]:
    """Run one of the servers of a database until the end, or until it is stopped."""
    loop, stopped, started = asyncio.new_event_loop(), asyncio.Event(), threading.Event()
    shares: list[Share] = []

    async def run() -> None:
        settings = ServerSettings(fusion=FusionSettings(grid=GRID), tls=tls)
        async with open_share(settings, url, address) as share:
            running = await start_server(address, share.services, tls)
            task = asyncio.create_task(share.run())
            shares.append(share)
            started.set()
            waiting = asyncio.create_task(stopped.wait())
            await asyncio.wait([task, waiting], return_when=asyncio.FIRST_COMPLETED)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await running.stop(0.0)

    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))

    def stop() -> None:
        if thread.is_alive():
            loop.call_soon_threadsafe(stopped.set)
            thread.join()

    thread.start()
    try:
        assert started.wait(30)
        with FusionClient(address, deadline_s=20.0, tls=client_tls) as client:
            yield SharingServer(address, shares[0], client, stop)
    finally:
        stop()
        loop.close()


@contextmanager
def sharing_servers(url: str, folder: Path, count: int) -> Iterator[list[SharingServer]]:
    """Run several servers, each with its part of the slots."""
    with ExitStack() as stack:
        servers = [stack.enter_context(sharing_server(url, f"unix:{folder}/{number}.sock")) for number in range(count)]
        wait_until_settled(servers)
        yield servers


def wait_until_settled(servers: list[SharingServer]) -> None:
    """Wait until every slot has an owner that serves it, and every server knows it."""
    addresses = {server.address for server in servers}

    def is_settled() -> bool:
        try:
            slots = [server.share.host.owned.slots for server in servers]
        except UnavailableError:
            return False
        return sum(map(len, slots)) == 256 and all(
            set(server.share.host.owners.server_of.values()) == addresses and server.share.host.owners.are_complete
            for server in servers
        )

    wait_until(is_settled)
