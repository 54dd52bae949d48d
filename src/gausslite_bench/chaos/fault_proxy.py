"""Forward the agents' connections to the server, and partition them on request."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine, Sequence
from pathlib import Path
from typing import TypeVar

_CHUNK_BYTES = 1 << 14
_Result = TypeVar("_Result")


class _Link:
    """The connections of one agent. Use it on the event loop only."""

    def __init__(self, path: Path, target: Path) -> None:
        self.path, self._target = path, target
        self._is_cut = False
        self._flows = asyncio.Event()
        self._flows.set()
        self._writers: set[asyncio.StreamWriter] = set()

    def set_fault(self, is_cut: bool, is_stalled: bool) -> None:
        self._is_cut = is_cut
        if is_stalled:
            self._flows.clear()
        else:
            self._flows.set()
        if is_cut:
            for writer in self._writers:
                writer.transport.abort()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_cut:
            writer.transport.abort()
            return
        try:
            upstream_reader, upstream_writer = await asyncio.open_unix_connection(self._target)
        except OSError:
            writer.transport.abort()
            return
        pair = {writer, upstream_writer}
        self._writers |= pair
        try:
            await asyncio.gather(self._pump(reader, upstream_writer), self._pump(upstream_reader, writer))
        finally:
            self._writers -= pair

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK_BYTES):
                await self._flows.wait()
                writer.write(data)
                await writer.drain()
        writer.close()


class FaultProxy:
    """Owns one listening socket per name, and a thread. The methods are thread-safe."""

    def __init__(self, folder: Path, names: Sequence[str], target: Path) -> None:
        """target: the socket of the server behind all of them."""
        self._links = {name: _Link(folder / f"{name}.sock", target) for name in names}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fault-proxy", daemon=True)
        self._thread.start()
        self._servers = [self._run(asyncio.start_unix_server(link.serve, link.path)) for link in self._links.values()]

    def address(self, agent_id: str) -> str:
        """Return where the agent has to connect."""
        return f"unix:{self._links[agent_id].path}"

    def set_fault(self, agent_id: str, is_cut: bool = False, is_stalled: bool = False) -> None:
        """Set the faults of the agent's connections, by default none.

        is_cut: reset them and refuse new ones. is_stalled: forward nothing without closing them, as when packets are
        lost.
        """

        async def apply() -> None:
            self._links[agent_id].set_fault(is_cut, is_stalled)

        self._run(apply())

    def close(self) -> None:
        """Close all connections and end the thread."""
        self._run(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        for server in self._servers:
            server.close()
        for link in self._links.values():
            link.set_fault(is_cut=True, is_stalled=False)
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _run(self, coroutine: Coroutine[object, object, _Result]) -> _Result:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(30)
