"""Fetch what teammates have mapped around the last known place of a lost robot, while it is searched in its own map."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid, empty_batch
from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import camera_from_message, message_to_values, transform_from_message
from gausslite.wire.uplink import Uplink

_log = logging.getLogger(__name__)
_NEIGHBOURHOOD_M, _REACH_M = 20.0, 6.0
"""Teammates' views up to so far from the last known place, and the map up to so far from these."""
_VIEWS_OF_A_ROBOT, _MAX_VIEWS = 24, 48
_INTERVAL_S = 60.0
"""A team's map grows; after an error, the server may be back."""
_NOT_FUSED = ("ALIGNMENT_STATE_QUARANTINED", "ALIGNMENT_STATE_UNLOCALISED")
_View = tuple[Camera, Float64[ndarray, "4 4"]]


@dataclass(frozen=True, slots=True, eq=False)
class TeamPart:
    """A part of the team's map without the robot's own, in the robot's frame, and views that teammates had of it."""

    revision: int
    gaussians: Gaussians
    grid: VoxelGrid
    views: Sequence[_View]

    def around(self, own: Gaussians) -> Gaussians:
        """Return a robot's map, with this part in the voxels where that has nothing."""
        is_new = ~np.isin(self.grid.keys(self.gaussians.means_m), self.grid.keys(own.means_m))
        return Gaussians.concatenate([own, self.gaussians.take(np.flatnonzero(is_new))])


class TeamPlaces:
    """The newest part of the team's map that has arrived. Its thread ends with the read."""

    def __init__(self, uplink: Uplink, place_m: Float64[ndarray, "3"]) -> None:
        """place_m: where the robot was last, in its own frame."""
        self._uplink, self._place_m = uplink, place_m
        self._thread: threading.Thread | None = None
        self._next_s = 0.0
        self.part: TeamPart | None = None

    def fetch(self) -> None:
        """Begin to read the map, unless that was done a moment ago."""
        is_reading = self._thread is not None and self._thread.is_alive()
        if not is_reading and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _INTERVAL_S
            self._thread = threading.Thread(target=self._read, name="team places", daemon=True)
            self._thread.start()

    def _read(self) -> None:
        try:
            part = read_part(self._uplink.client, self._uplink.agent_id, self._place_m)
        except (GaussLiteError, ValueError) as error:  # ValueError: the channel has been closed
            _log.warning("the team's map is not searched: %s", error)
            return
        if part is not None and (self.part is None or part.revision != self.part.revision):
            self.part = part


def read_part(client: FusionClient, agent_id: str, place_m: Float64[ndarray, "3"]) -> TeamPart | None:
    """Return what teammates have mapped around a place of a robot's frame.

    None while its frame does not fit the team's, or without keyframes of teammates there. Raises GaussLiteError.
    """
    team = {agent.agent_id: agent for agent in client.status().agents}
    own = team.pop(agent_id, None)
    if own is None or message_to_values(own.alignment)["state"] in _NOT_FUSED:
        return None
    T_fused_agent = transform_from_message("t_fused_agent", own.alignment.t_fused_agent)
    place_fused_m = transform_points(T_fused_agent, place_m[None])[0]
    views = sorted(_views(client, team), key=lambda view: _away_m(view, place_fused_m))[:_MAX_VIEWS]
    near = [view for view in views if _away_m(view, place_fused_m) < _NEIGHBOURHOOD_M]
    if not near:
        return None
    corners_m = [T[:3, 3] + side for _, T in near for side in (-_REACH_M, _REACH_M)]
    batch, grid, revision = empty_batch(), VoxelGrid(), 0
    for update in client.watch(0, AxisAlignedBox.around(np.array(corners_m)), exclude_agent=agent_id):
        batch, grid, revision = update.apply_to(batch), update.grid or grid, update.revision
        if update.last:
            break
    T_agent_fused = inverse(T_fused_agent)
    moved = [(camera, T_agent_fused @ T) for camera, T in near]
    return TeamPart(revision, move_gaussians(batch.gaussians, T_agent_fused), grid, moved)


def _views(client: FusionClient, team: Mapping[str, Any]) -> Iterator[_View]:
    """Yield the cameras of keyframes of each agent, spread over its mission, with their poses in the fused frame."""
    for name, agent in team.items():
        indices = client.keyframe(name).indices if agent.keyframes else []
        spread = np.linspace(0, len(indices) - 1, min(_VIEWS_OF_A_ROBOT, len(indices))).round().astype(np.int64)
        for i in spread.tolist():
            keyframe = client.keyframe(name, indices[i])
            if keyframe.HasField("t_world_camera"):
                T = transform_from_message("keyframe t_world_camera", keyframe.t_world_camera)
                yield camera_from_message(keyframe.camera), T


def _away_m(view: _View, place_m: Float64[ndarray, "3"]) -> float:
    return float(np.linalg.norm(view[1][:3, 3] - place_m))
