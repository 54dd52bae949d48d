"""A place that programs ask: the objects and the map of a run's folder, a fusion server or an agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from threading import RLock
from typing import Final, Protocol, TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.ply import StoredMap, gaussians_from_ply
from gausslite.codec.run_files import KeyframeView, read_keyframe_views
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.objects import TeamObject
from gausslite.domain.pose import UpAxis, inverse, upward_axis
from gausslite.domain.voxels import empty_batch
from gausslite.mapping.free_space import DepthView
from gausslite.render.rasterizer import Rendering
from gausslite.wire.channel import is_agent, require_callable
from gausslite.wire.clients import AgentClient, Export, FusionClient
from gausslite.wire.convert import camera_from_message, transform_from_message
from gausslite.wire.security import Tls
from gausslite_export.formats import upright_motion
from gausslite_export.occupancy import NO_VOXELS, FloorGrid, OccupancySettings, planar_grid, require_voxels
from gausslite_export.surface_votes import count_votes, rendered_depths
from gausslite_objects.areas import read_areas
from gausslite_objects.edits import read_edits
from gausslite_objects.mapped_objects import MappedObjects, open_memory, query, read_folder
from gausslite_objects.object_memory import ObjectMemory
from gausslite_objects.visit import depth_views, read_depths
from gausslite_render.splat_map import read_splats
from gausslite_render.viewer import SplatViewer

_Value = TypeVar("_Value")
_MAX_VIEWS: Final = 48
_RENDERED_VIEWS: Final = 16
"""Keyframes that a place uses, and renders for its grid if their depth is not kept, evenly in their order."""


@dataclass(eq=False)
class Scene:
    """A map to look at, with the views that its keyframes saw, oldest first. Its methods are thread-safe.

    depths: the depth that keyframes measured, where it is kept.
    """

    splats: StoredMap
    views: Sequence[KeyframeView]
    up_axis: UpAxis
    threads: int | None = None
    depths: Sequence[DepthView] = ()
    _lock: RLock = field(default_factory=RLock, repr=False)

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Rendering:
        """Return the map's rendering from a pose."""
        with self._lock:
            return self._viewer.render(camera, T_world_camera)

    @cached_property
    def _viewer(self) -> SplatViewer:
        return SplatViewer(self.splats, self.threads)

    def floor(self) -> FloorGrid:
        """Return the grid of what a robot can drive on, as `gausslite export --to nav2` writes it.

        Raises InvalidInputError for a map without anything that occupies space.
        """
        with self._lock:
            return self._floor

    @cached_property
    def _floor(self) -> FloorGrid:
        T, settings = upright_motion(np.array(self.up_axis)), OccupancySettings()
        if not self.views:
            gaussians = move_gaussians(self.splats.gaussians, T)
            return planar_grid(require_voxels(gaussians, settings), NO_VOXELS, settings, T)
        seen = self.depths or rendered_depths(evenly(self.views, _RENDERED_VIEWS), self.render)
        turned = (replace(view, T_camera_world=view.T_camera_world @ inverse(T)) for view in seen)
        votes = count_votes(turned, settings.voxel_m)
        surface = votes.surface()
        if not len(surface):
            raise InvalidInputError(f"map: expected surfaces that the {len(self.views)} keyframes show, got none")
        return planar_grid(surface, votes.free(), settings, T)


class Place(Protocol):
    """What `gausslite mcp` serves."""

    @property
    def name(self) -> str:
        """How the user named it."""
        ...

    def objects(self) -> MappedObjects:
        """Return the objects of now. Raises UnavailableError."""
        ...

    def scene(self) -> Scene:
        """Return the map of now. Raises UnavailableError, MapFileError."""
        ...

    def memory(self) -> ObjectMemory:
        """Return what people say of the place. Raises UnavailableError, MapFileError."""
        ...


class RunPlace:
    """A run's folder. The map is read once, objects again after an edit."""

    def __init__(self, folder: Path, threads: int | None = None) -> None:
        """Raises InvalidInputError, MapFileError, CodecError."""
        self.name, self._folder = str(folder), folder
        self._said, self._objects = self._read_said(), read_folder(folder)
        views = read_keyframe_views(folder)
        depths, _ = depth_views(views, read_depths(folder, views))
        self._scene = Scene(read_splats(folder), evenly(views, _MAX_VIEWS), self._objects.up_axis, threads, depths)

    def objects(self) -> MappedObjects:
        """Return the objects of report.json after edits."""
        said = self._read_said()
        if said != self._said:
            self._said, self._objects = said, read_folder(self._folder)
        return self._objects

    def _read_said(self) -> tuple[object, ...]:
        return read_edits(self._folder), read_areas(self._folder)

    def scene(self) -> Scene:
        """Return the map of map.ply."""
        return self._scene

    def memory(self) -> ObjectMemory:
        """Return the edits and areas in the folder."""
        return open_memory(self.name)


class ServicePlace:
    """A fusion server or an agent: each call sees its objects of now; the map is fetched again when it has changed."""

    def __init__(self, address: str, tls: Tls | None = None, threads: int | None = None) -> None:
        require_callable("no such folder; a fusion server or an agent", address)
        self.name, self._tls, self._threads = address, tls, threads
        self._lock, self._revision = RLock(), -1
        self._scene: Scene | None = None

    def objects(self) -> MappedObjects:
        """Return the objects of the team or of the agent. Raises UnavailableError."""
        return query(self.name, self._tls)

    def memory(self) -> ObjectMemory:
        """Return the edits and areas of the service."""
        return open_memory(self.name, self._tls)

    def scene(self) -> Scene:
        """Return the map with the keyframes that the service has. Raises UnavailableError, InvalidInputError."""
        with self._lock:
            read = _agent_map if is_agent(self.name, self._tls) else _team_map
            newer = read(self.name, self._tls, self._revision)
            if newer is not None:
                gaussians = newer.gaussians
                if not len(gaussians):
                    raise InvalidInputError(f"{self.name}: expected a map with Gaussians, got an empty one")
                splats = StoredMap(gaussians, "", np.zeros((len(gaussians), 3, 0), np.float32))
                self._scene = Scene(splats, evenly(newer.views, _MAX_VIEWS), newer.up_axis, self._threads)
                self._revision = newer.revision
            assert self._scene is not None
            return self._scene


@dataclass(frozen=True, slots=True, eq=False)
class _LiveMap:
    """What a service maps at a revision."""

    revision: int
    gaussians: Gaussians
    views: Sequence[KeyframeView]
    up_axis: UpAxis = (0.0, 0.0, 1.0)


def _team_map(address: str, tls: Tls | None, known: int) -> _LiveMap | None:
    """Return the fused map; None if its revision is known."""
    with FusionClient(address, tls=tls) as client:
        status = client.status()
        if status.fused_revision == known:
            return None
        agents = [agent.agent_id for agent in status.agents if agent.keyframes]
        views = [view for agent_id in agents for view in _agent_views(client, agent_id)]
        return _LiveMap(status.fused_revision, gaussians_from_ply(client.export(Export())), views)


def _agent_map(address: str, tls: Tls | None, known: int) -> _LiveMap | None:
    """Return an agent's map; None if its revision is known."""
    with AgentClient(address, tls=tls) as client:
        revision, batch = client.status().map_revision, empty_batch()
        if revision == known:
            return None
        for update in client.watch_map():
            batch = update.apply_to(batch)
            if update.last:
                break
        seen = client.camera_view()
    poses = [transform_from_message("keyframes", message) for message in seen.keyframes]
    views = [KeyframeView(i, 0, camera_from_message(seen.camera), T, 0) for i, T in enumerate(poses)]
    return _LiveMap(revision, batch.gaussians, views, upward_axis(np.reshape(poses, (-1, 4, 4))))


def open_place(place: str, tls: Tls | None = None, threads: int | None = None) -> Place:
    """Return the place of a folder's path or a service's address. Raises InvalidInputError, MapFileError."""
    return RunPlace(Path(place), threads) if Path(place).is_dir() else ServicePlace(place, tls, threads)


def find_object(objects: MappedObjects, name: str) -> TeamObject:
    """Return the object of an id, or the most confident one of a noun. Raises InvalidInputError, which lists ids."""
    found = [known_object for known_object in objects.objects if known_object.landmark.object_id == name]
    found = found or [known_object for known_object in objects.objects if known_object.landmark.noun == name]
    if not found:
        known = ", ".join(known_object.landmark.object_id for known_object in objects.objects[:20]) or "none"
        raise InvalidInputError(f"object: expected the id or the noun of an object, got {name[:80]!r}; ids are {known}")
    return max(found, key=lambda each: each.landmark.confidence)


def _agent_views(client: FusionClient, agent_id: str) -> list[KeyframeView]:
    """Return the poses of an agent's keyframes in the fused map, without their images."""
    views = []
    for index in evenly(client.keyframe(agent_id).indices, _MAX_VIEWS):
        message = client.keyframe(agent_id, index)
        if message.HasField("t_world_camera"):
            T = transform_from_message("t_world_camera", message.t_world_camera)
            views.append(KeyframeView(index, message.capture_time_ns, camera_from_message(message.camera), T, 0))
    return views


def evenly(values: Sequence[_Value], count: int) -> list[_Value]:
    """Return at most `count` of the values, evenly in their order, with the last one."""
    return list(values[::-1][:: max(1, -(-len(values) // count))][::-1])
