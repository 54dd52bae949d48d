"""Run a server in this process, on an event loop in a thread; its messages pass a unix socket as real bytes."""

import asyncio
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from gausslite.wire.call_limits import CallLimits
from gausslite.wire.security import Tls
from gausslite.wire.server import RunningServer, Service, start_server


@contextmanager
def serving(
    services: list[Service],
    listen: str | None = None,
    tls: Tls | None = None,
    limits: CallLimits | None = None,
    health_listen: str | None = None,
) -> Iterator[RunningServer]:
    """Start a server on `listen`, or else a socket of its own (with `tls` a port); it is drained at the end."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            address = listen or (f"unix:{folder}/service.sock" if tls is None else "127.0.0.1:0")
            starting = start_server(address, services, tls, limits, health_listen)
            running = asyncio.run_coroutine_threadsafe(starting, loop).result(10)
            try:
                yield running
            finally:
                asyncio.run_coroutine_threadsafe(running.stop(1.0), loop).result(10)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
