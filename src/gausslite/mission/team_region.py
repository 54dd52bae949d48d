"""Select the voxels of a teammate's map that belong to the region of this agent's task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gausslite.domain.objects import TeamObject
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import select_voxels
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid

_MARGIN_M = 0.05


@dataclass(frozen=True, slots=True)
class TeamRegion:
    """The boxes of the task's targets that the team has observed, each with the target's index in the task."""

    boxes: tuple[tuple[AxisAlignedBox, int], ...] = ()

    @classmethod
    def of(cls, graph: TaskGraph, objects: Sequence[TeamObject]) -> TeamRegion:
        """Return the region of the objects whose noun is a target of the task, with a margin."""
        found = [each.landmark for each in objects if each.landmark.noun in graph.targets]
        boxes = [(each.extent_m, graph.targets.index(each.noun)) for each in found]
        return cls(tuple(sorted(((_grown(box), target) for box, target in boxes), key=lambda each: each[0].min_m)))

    @property
    def bounds(self) -> AxisAlignedBox | None:
        """The box around all boxes; None without any."""
        if not self.boxes:
            return None
        low_x, low_y, low_z = np.min([box.min_m for box, _ in self.boxes], axis=0).tolist()
        high_x, high_y, high_z = np.max([box.max_m for box, _ in self.boxes], axis=0).tolist()
        return AxisAlignedBox((low_x, low_y, low_z), (high_x, high_y, high_z))

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


def _grown(box: AxisAlignedBox) -> AxisAlignedBox:
    low, high = (np.array(corner) + side * _MARGIN_M for corner, side in ((box.min_m, -1), (box.max_m, 1)))
    return AxisAlignedBox((low[0], low[1], low[2]), (high[0], high[1], high[2]))
