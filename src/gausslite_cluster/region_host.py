"""Own a share of a mission's slots: follow which servers run, take and release slots, open the engine of those held.

An engine has a fixed set of slots. When the set changes, it is closed and another one is opened from the rows.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from typing import TypeVar

from gausslite.domain.errors import GaussLiteError, MismatchError, StorageError, UnavailableError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.traffic import TrafficLog
from gausslite.wire.convert import decode_frame
from gausslite.wire.views import ChangeNotifier
from gausslite_cluster.postgres_regions import SharedSlots
from gausslite_cluster.postgres_store import PostgresStore
from gausslite_cluster.regions import OwnedSlots, Owners, wanted_slots
from gausslite_fusion_server.servicer import FusionServicer

_POLL_S, _QUICK_POLL_S, _PAUSE_S = 2.0, 0.5, 0.1
"""Times between two looks at the owners: while nothing changes, while regions move, and after a call that failed."""
WAIT_S = 10.0
"""Longest wait for the owner of a slot: a message or a call waits for a server that takes over."""
_log = logging.getLogger(__name__)
_Value = TypeVar("_Value")


class RegionHost:
    """Owns the slots and the open engine, served by what create_servicer returns. Use it on the event loop."""

    def __init__(
        self, slots: SharedSlots, settings: FusionSettings, create_servicer: Callable[[FusionEngine], FusionServicer]
    ) -> None:
        self._slots, self.settings, self._create_servicer = slots, settings, create_servicer
        self._store: PostgresStore | None = None
        self._local: FusionServicer | None = None
        # the connection and the slots of the open engine
        self._opened: tuple[int, frozenset[int]] | None = None
        self._owned = OwnedSlots(frozenset())
        self.server = slots.server
        """The address of this server among the others."""
        self.owners = Owners()
        """Who owned which slot at the latest look."""
        # those at the latest look that had nothing to do
        self._steady: Owners | None = None
        self._woken = asyncio.Event()
        self._failure = ""
        self.changes = ChangeNotifier()
        """Notified when the owners, or the open engine, have changed."""
        self.traffic = TrafficLog()
        """Of the messages that this server received."""

    @property
    def owned(self) -> OwnedSlots:
        """The slots of the open engine. Raises UnavailableError without one."""
        self.local()
        return self._owned

    def local(self) -> FusionServicer:
        """Return what serves this server's own part. Raises UnavailableError while it is opened."""
        if self._local is None:
            raise UnavailableError(f"server {self.server}: it is taking its regions; try again in a moment")
        return self._local

    def wake(self) -> None:
        """Look at the owners soon, because a server did not answer."""
        self._woken.set()

    def check(self) -> None:
        """Raise UnavailableError or StorageError while this server cannot store its part."""
        self.local().engine.storage.check()

    async def ready(self) -> FusionServicer:
        """Return what serves this server's own part as soon as it is open. Raises UnavailableError after 10 s."""
        return await self.wait_for(self.local)

    async def wait_for(self, find: Callable[[], _Value]) -> _Value:
        """Return what `find` returns, as soon as it does not raise UnavailableError, which is raised after 10 s."""
        end_s = asyncio.get_running_loop().time() + WAIT_S
        while True:
            changed = self.changes.subscribe()
            try:
                return find()
            except UnavailableError:
                self.wake()
                remaining_s = end_s - asyncio.get_running_loop().time()
                if remaining_s <= 0:
                    raise
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), remaining_s)

    async def run(self) -> None:
        """Follow the owners until it is cancelled.

        Raises MismatchError, CodecError for a mission that it cannot serve, StorageError if the first look fails.
        """
        await self._look()
        while True:
            await asyncio.sleep(_PAUSE_S)
            with contextlib.suppress(TimeoutError):
                pause_s = _QUICK_POLL_S if self._steady is None else _POLL_S
                await asyncio.wait_for(self._woken.wait(), pause_s - _PAUSE_S)
            self._woken.clear()
            try:
                await self._look()
                if self._failure:
                    _log.info("server %s: it shares the store again", self.server)
                self._failure = ""
            except (StorageError, UnavailableError) as error:
                # the latter if the locks are lost while the engine is opened
                if not self._failure:
                    _log.error("server %s: %s; trying again", self.server, error)
                self._failure = str(error)

    async def close(self) -> None:
        """Close the engine and give all slots up."""
        await self._close_local()
        await asyncio.to_thread(self._slots.close)

    async def _look(self) -> None:
        """Follow the owners once; a cancellation waits for its end, so that no opened store is left behind."""
        looking = asyncio.ensure_future(self._follow())
        try:
            await asyncio.shield(looking)
        except asyncio.CancelledError:
            await asyncio.gather(looking, return_exceptions=True)
            raise

    async def _follow(self) -> None:
        owners = await asyncio.to_thread(self._slots.owners)
        is_open = self._opened == (self._slots.connection, self._slots.held)
        if owners is self._steady and is_open:
            return
        wanted = wanted_slots(owners.servers, self.server)
        await asyncio.to_thread(self._slots.take, wanted)
        surplus = self._slots.held - wanted
        self._steady = owners if owners.are_complete and is_open and self._slots.held == wanted else None
        if surplus or self._opened != (self._slots.connection, self._slots.held):
            await self._close_local()
            await asyncio.to_thread(self._slots.release, surplus)
            await self._open_local()
            owners = await asyncio.to_thread(self._slots.owners)
        if owners != self.owners:
            self.owners = owners
            self.changes.notify()

    async def _open_local(self) -> None:
        connection, held = self._slots.connection, self._slots.held
        engine = await asyncio.to_thread(self._open_engine)
        self._local, self._opened = self._create_servicer(engine), (connection, held)
        self._owned = OwnedSlots(held)
        _log.info("server %s: serves %d of the mission's regions", self.server, len(held))
        self.changes.notify()

    def _open_engine(self) -> FusionEngine:
        store = self._slots.open_store()
        try:
            store.set_mission_config(self.settings.mission_config)
            engine = FusionEngine(store, self.settings, decode_keyframe=decode_frame, traffic=self.traffic)
            moved = sorted(engine.frames.unused | engine.frames.transforms().keys())
            if moved:
                raise MismatchError(
                    f"server {self.server}: the frames of {', '.join(moved[:8])} differ from the fused "
                    "map's, and servers that share a mission trust frames; evict these agents, or run one server "
                    "without peer-address"
                )
        except GaussLiteError:
            store.close()
            raise
        self._store = store
        return engine

    async def _close_local(self) -> None:
        local, self._local, self._opened = self._local, None, None
        if local is None or self._store is None:
            return
        local.drain()
        await asyncio.to_thread(local.close)
        await asyncio.to_thread(self._store.close)
