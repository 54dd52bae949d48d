"""What a server finds as plug-ins: databases, figures for monitors, views and refinements of its map."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.fusion.engine import FusionEngine, WorkDone
from gausslite.fusion.fused_map import FusedMapLayers, MapLayer
from gausslite.fusion.refinement import CreateRasterizer, RefineProgress, RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.traffic import Acknowledgements
from gausslite.plugins import Group, installed, load
from gausslite.render.rasterizer import Rendering
from gausslite.wire.server import Service
from gausslite_fusion_server.settings import ServerSettings

FindEngine = Callable[[], FusionEngine]


class MessageCounts(NamedTuple):
    """Of a server that shares a mission: messages of agents, parts sent to owners and stored as one, and parts refused
    because their voxels are another server's.
    """

    received: int
    sent: int
    stored: int
    foreign: int


FindCounts = Callable[[], MessageCounts]
MetricsServer = Callable[[str, FindEngine, Acknowledgements, FindCounts | None], AbstractContextManager[int]]
"""A plug-in of the group gausslite.metrics: serves the figures of a server at HOST:PORT; gives the actual port.

Raises InvalidInputError for another address, UnavailableError if it is in use.
"""


def added_services(engine: FindEngine) -> list[Service]:
    """Return what plug-ins of the group gausslite.server_services add to a server: each is a function of its engine."""
    return [create(engine) for _, create in installed(Group.SERVER_SERVICES)]


class MapRenderer(Protocol):
    """Renders the fused map from any pose, on one thread."""

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], layer: MapLayer, /
    ) -> tuple[Rendering | None, int]:
        """Return a view of a layer, None of an empty one, and the layer's revision. Raises KernelError."""


OpenRenderer = Callable[[FusedMapLayers, CreateRasterizer], MapRenderer]
"""The default of the group gausslite.map_renderers."""


class Refiner(Protocol):
    """Refines a server's fused map, one refinement at a time, and judges who wins its voxels."""

    def run(self, engine: FusionEngine, settings: RefineSettings) -> AsyncIterator[RefineProgress]:
        """Refine the engine's map, yield the latest progress, and store the result. Closing the iterator cancels.

        Raises QuotaError if another refinement runs or the map exceeds max_gaussians, InvalidInputError if no keyframe
        agrees with the map.
        """

    def judge(self, engine: FusionEngine) -> WorkDone:
        """Let the maps win that fit the agents' keyframes best, without a lock. Call it from one thread at a time."""

    def close(self) -> None:
        """Wait until the last refinement has ended after its cancellation; end a judgement."""


OpenRefiner = Callable[[CreateRasterizer], Refiner]
"""The default of the group gausslite.refiners."""


class Share(Protocol):
    """One of the servers of a mission: what it serves, and what it has to run meanwhile."""

    @property
    def services(self) -> list[Service]:
        """The services for agents, watchers and other servers."""

    @property
    def acknowledgements(self) -> Acknowledgements:
        """Of the messages that agents have sent to this server."""

    async def run(self) -> None:
        """Take part until it is cancelled; then end the open streams, and leave the rest to the other servers."""

    def engine(self) -> FusionEngine:
        """Return the engine of the part that this server owns. Raises UnavailableError while it is opened."""

    def counts(self) -> MessageCounts:
        """Return how much of the mission's work this server has done."""


class Database(Protocol):
    """A plug-in of the group gausslite.stores. Raises InvalidInputError, StorageError."""

    def open_store(self, url: str) -> FusionStore:
        """Return the store of a database for one server."""

    def open_share(self, settings: ServerSettings, url: str, peer_address: str) -> AbstractAsyncContextManager[Share]:
        """Take part in the mission of a database, together with other servers, while the context is open."""


def open_store(settings: ServerSettings) -> FusionStore:
    """Return the store. Raises InvalidInputError, StorageError."""
    if settings.store is None:
        return SqliteStore()
    if isinstance(settings.store, Path):
        return SqliteStore(settings.store, settings.store_max_bytes)
    return database_of(settings.store).open_store(settings.store)


def database_of(url: str) -> Database:
    """Return the plug-in for a URL. Raises MissingPluginError, which names what is not installed."""
    database: Database = load(Group.STORES, url.partition("://")[0])
    return database
