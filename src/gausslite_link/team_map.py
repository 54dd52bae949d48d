"""Follow the fused map in the region of an agent's task, and insert voxels that teammates trained more.

`TeamMapFollower` is the default plug-in of the group `gausslite.team_maps`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import GaussLiteError, RevisionGoneError
from gausslite.domain.gaussians import move_gaussians
from gausslite.domain.objects import TeamObject
from gausslite.domain.pose import inverse
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch, VoxelGrid, group_by_voxel, select_voxels
from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import MapUpdate, transform_from_message
from gausslite_agent.mapping_worker import MappingWorker

_MARGIN_M = 0.05


@dataclass(frozen=True, slots=True)
class TeamRegion:
    """The boxes of the task's targets that the team has observed, each with the target's index in the task."""

    boxes: tuple[tuple[AxisAlignedBox, int], ...] = ()

    @classmethod
    def of(cls, graph: TaskGraph, objects: Sequence[TeamObject]) -> TeamRegion:
        """Return the region of the objects whose noun is a target of the task, with a margin."""
        found = [team_object.landmark for team_object in objects if team_object.landmark.noun in graph.targets]
        corners = [
            (np.array(own.extent_m.min_m) - _MARGIN_M, np.array(own.extent_m.max_m) + _MARGIN_M) for own in found
        ]
        grown = [AxisAlignedBox.around(np.array(both)) for both in corners]
        targets = [graph.targets.index(landmark.noun) for landmark in found]
        return cls(tuple(sorted(zip(grown, targets, strict=True), key=lambda boxed: boxed[0].min_m)))

    @property
    def bounds(self) -> AxisAlignedBox | None:
        """The box around all boxes; None without any."""
        if not self.boxes:
            return None
        return AxisAlignedBox.around(np.array([corner for box, _ in self.boxes for corner in (box.min_m, box.max_m)]))

    def select(self, batch: VoxelBatch, grid: VoxelGrid) -> VoxelBatch:
        """Return the voxels of the region; their Gaussians are active for the target in whose box the voxel is."""
        centres = grid.centres_m(batch.keys)
        target = np.full(len(batch), -1, np.int16)
        for box, index in self.boxes:
            target[box.contains(centres) & (target < 0)] = index
        inside = (target >= 0) & (batch.counts > 0)
        chosen = select_voxels(batch, inside)
        of_gaussians = np.repeat(target[inside], chosen.counts)
        gaussians = replace(chosen.gaussians, active=np.ones(len(of_gaussians), np.bool_), target=of_gaussians)
        return VoxelBatch(chosen.keys, chosen.kappa_sums, chosen.counts, gaussians)


_log = logging.getLogger(__name__)
_INTERVAL_S = 2.0


class TeamMapFollower:
    """Owns a thread and a client that read the changes of the fused map every two seconds.

    layer: "vote" for the teammates' voxels as they trained them, "refined" also for the refinement of own voxels.
    """

    def __init__(self, client: FusionClient, agent_id: str, layer: str, worker: MappingWorker) -> None:
        self._client, self._agent_id, self._layer, self._worker = client, agent_id, layer, worker
        self._region = TeamRegion()
        self._revision = 0
        self._last_error = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="team-map", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and the connection."""
        self._closing.set()
        self._client.close()
        self._thread.join()

    def follow_once(self) -> None:
        """Read the changes since the last call and insert those of the task's region. Raises GaussLiteError."""
        graph = self._worker.status().graph
        if graph is None or self._agent_id in self._client.unlocalised():
            return
        region = TeamRegion.of(graph, self._client.query_objects())
        if region != self._region:
            # voxels of a new region may have changed before
            self._region, self._revision = region, 0
        if region.bounds is None:
            return
        try:
            self._read(region)
        except RevisionGoneError:
            self._revision = 0

    def _run(self) -> None:
        while not self._closing.wait(_INTERVAL_S):
            try:
                self.follow_once()
                self._last_error = ""
            except GaussLiteError as error:
                if not self._closing.is_set() and str(error) != self._last_error:
                    _log.warning("team map: %s; retrying", error)
                    self._last_error = str(error)

    def _read(self, region: TeamRegion) -> None:
        T_agent_fused = inverse(self._own_frame())
        exclude = "" if self._layer == "refined" else self._agent_id
        updates = self._client.watch(self._revision, region.bounds, self._layer, exclude)
        for update in updates:
            if update.batch is not None:
                self._insert_region(update, region, T_agent_fused)
            if update.last:
                # each block names the final revision: after an error in between, the next call reads all blocks again
                self._revision = update.revision
                return

    def _insert_region(self, update: MapUpdate, region: TeamRegion, T_agent_fused: Float64[ndarray, "4 4"]) -> None:
        assert update.batch is not None
        winners = np.array([*update.winners, *[""] * (len(update.batch) - len(update.winners))])
        for agent_id in sorted(set(winners.tolist())):
            batch = region.select(select_voxels(update.batch, winners == agent_id), self._worker.grid)
            moved = group_by_voxel(move_gaussians(batch.gaussians, T_agent_fused), self._worker.grid)
            if len(moved):
                self._worker.insert_team_voxels(moved).result()

    def _own_frame(self) -> Float64[ndarray, "4 4"]:
        """Return T_fused_agent of this agent, as the server estimates it."""
        for agent in self._client.status().agents:
            if agent.agent_id == self._agent_id and len(agent.alignment.t_fused_agent.row_major) == 16:
                return transform_from_message("t_fused_agent", agent.alignment.t_fused_agent)
        return np.eye(4)
