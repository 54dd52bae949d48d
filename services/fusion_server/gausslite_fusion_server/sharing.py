"""Put together a server that shares a mission with the other servers of its database."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial

from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.postgres_regions import SharedSlots
from gausslite.render.choose import choose_rasterizer
from gausslite.wire.server import Service
from gausslite_fusion_server.metrics import MessageCounts
from gausslite_fusion_server.part_sender import PartSender
from gausslite_fusion_server.peers import Peers
from gausslite_fusion_server.refinement_worker import RefinementWorker
from gausslite_fusion_server.region_host import RegionHost
from gausslite_fusion_server.region_servicer import RegionServicer
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import ServerSettings
from gausslite_fusion_server.shared_servicer import SharedServicer

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Share:
    """One of the servers of a mission: what it serves, and what it has to run meanwhile."""

    host: RegionHost
    regions: RegionServicer
    sender: PartSender
    servicer: SharedServicer

    @property
    def services(self) -> list[Service]:
        """The service for agents and watchers, and the one for the other servers."""
        return [self.servicer.service(), self.regions.service()]

    async def run(self) -> None:
        """Take part until it is cancelled; then end the open streams, and leave the regions to the other servers."""
        try:
            await self.host.run()
        finally:
            self.servicer.drain()
            await self.host.close()

    def engine(self) -> FusionEngine:
        """Return the engine of the part that this server owns. Raises UnavailableError while it is opened."""
        return self.host.local().engine

    def counts(self) -> MessageCounts:
        """Return how much of the mission's work this server has done."""
        return MessageCounts(self.sender.received, self.sender.sent, self.regions.stored, self.regions.foreign)


def shared_settings(settings: FusionSettings) -> FusionSettings:
    """Return the settings of a server that shares a mission: names are fixed, and frames are trusted."""
    agreed = settings.mission_config.with_default_names()
    return replace(settings, mission_id=agreed.mission_id, world_frame=agreed.world_frame, alignment=None)


@asynccontextmanager
async def open_share(settings: ServerSettings, peer_address: str) -> AsyncIterator[Share]:
    """Take part in a mission while the context is open. Raises InvalidInputError, StorageError."""
    assert isinstance(settings.store, str)
    slots = await asyncio.to_thread(SharedSlots, settings.store, peer_address)
    _log.info("server %s: shares its mission; frames of agents are used as they are (trust)", peer_address)

    def create_servicer(engine: FusionEngine) -> FusionServicer:
        return FusionServicer(
            engine, RefinementWorker(settings.refine, partial(choose_rasterizer, settings.rasterizer))
        )

    fusion = shared_settings(settings.fusion)
    host, peers = RegionHost(slots, fusion, create_servicer), Peers(settings.tls)
    regions = RegionServicer(host)
    sender = PartSender(host, regions, peers, fusion.grid)
    try:
        yield Share(host, regions, sender, SharedServicer(host, regions, peers, sender))
    finally:
        await host.close()
        await asyncio.to_thread(sender.close)
        await peers.close()
