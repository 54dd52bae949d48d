"""Compare the voxels that an agent wins with the other agents' keyframes.

The vote believes kappa: an agent that reports much training wins, whatever its Gaussians look like. The check renders
the fused map with and without the agent into keyframes of other agents, where these see voxels that the agent has won
from somebody. An honest winner brings the rendering closer to the photographs, or leaves it as close.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.fusion.vote import FusedMap, fuse
from gausslite.render.rasterizer import Rasterizer
from gausslite.render.row_encoding import gaussians_to_rows

_MAX_KEYFRAMES, _MIN_KEYFRAMES, _MIN_PIXELS = 16, 3, 64
_COVERED_ALPHA = 0.5
_WORSE_RATIO, _WORSE_BY = 1.25, 0.02
"""A keyframe speaks against an agent whose error is this much larger than the others': honest maps differ by less."""
_WORSE_SHARE = 0.75


class ClaimVerdict(StrEnum):
    """What the keyframes of other agents say about the voxels that an agent wins."""

    CONFIRMED = "confirmed"
    NOT_CONFIRMED = "not confirmed"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class ClaimReport:
    """The check of one agent. contested_voxels: those that it wins and another agent has, too.

    keyframes: those of other agents that see enough of them; worse_keyframes: in which the map is clearly worse with
    the agent than without it. error, error_without: mean absolute differences to the keyframes' colours, 0 to 1.
    """

    agent_id: str
    contested_voxels: int
    keyframes: int
    worse_keyframes: int
    error: float
    error_without: float

    @property
    def verdict(self) -> ClaimVerdict:
        """UNKNOWN with fewer than three keyframes."""
        if self.keyframes < _MIN_KEYFRAMES:
            return ClaimVerdict.UNKNOWN
        is_worse = self.worse_keyframes >= _WORSE_SHARE * self.keyframes
        return ClaimVerdict.NOT_CONFIRMED if is_worse else ClaimVerdict.CONFIRMED


def check_claims(
    updates: Mapping[str, VoxelBatch], keyframes: Sequence[AgentKeyframe], grid: VoxelGrid, rasterizer: Rasterizer
) -> list[ClaimReport]:
    """Return a report for each agent, by agent id. keyframes: in the fused map's frame."""
    fused = fuse(updates)
    return [_check_agent(agent_id, fused, updates, keyframes, grid, rasterizer) for agent_id in sorted(updates)]


def _check_agent(
    agent_id: str,
    fused: FusedMap,
    updates: Mapping[str, VoxelBatch],
    keyframes: Sequence[AgentKeyframe],
    grid: VoxelGrid,
    rasterizer: Rasterizer,
) -> ClaimReport:
    others = fuse({name: batch for name, batch in updates.items() if name != agent_id})
    won = fused.batch.keys[fused.won_by(agent_id)]
    contested = np.intersect1d(won, others.batch.keys)
    views = _views_of(agent_id, contested, keyframes, grid)
    rows, rows_without = (gaussians_to_rows(each.gaussians) for each in (fused, others))
    errors = []
    for frame, mask in views:
        T_camera_world = inverse(frame.T_world_camera)
        with_agent, without = (
            rasterizer.forward(each, frame.camera, T_camera_world, motion=frame.motion) for each in (rows, rows_without)
        )
        compared = mask & (without.alpha > _COVERED_ALPHA)
        if np.count_nonzero(compared) >= _MIN_PIXELS:
            errors.append([_error(each.rgb, frame, compared) for each in (with_agent, without)])
    pairs: Float64[ndarray, "n 2"] = np.array(errors).reshape(-1, 2)
    is_worse = pairs[:, 0] > _WORSE_RATIO * pairs[:, 1] + _WORSE_BY
    error, error_without = pairs.mean(axis=0) if len(pairs) else (0.0, 0.0)
    return ClaimReport(
        agent_id, len(contested), len(pairs), int(np.count_nonzero(is_worse)), float(error), float(error_without)
    )


def _views_of(
    agent_id: str, contested: Int64[ndarray, " k"], keyframes: Sequence[AgentKeyframe], grid: VoxelGrid
) -> list[tuple[Frame, Bool[ndarray, "h w"]]]:
    """Return the other agents' keyframes that see most of these voxels, with the pixels that show them."""
    views = [
        (each.frame, mask)
        for each in keyframes
        if each.agent_id != agent_id
        for mask in _pixels_of(each.frame, contested, grid)
    ]
    views.sort(key=lambda view: -np.count_nonzero(view[1]))
    return views[:_MAX_KEYFRAMES]


def _pixels_of(frame: Frame, keys: Int64[ndarray, " k"], grid: VoxelGrid) -> Iterator[Bool[ndarray, "h w"]]:
    """Yield the mask of the pixels whose measured surface lies in these voxels, unless they are too few."""
    points = transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera).reshape(-1, 3))
    inside = (frame.depth_m > 0).ravel() & (np.abs(points) < grid.max_coordinate_m).all(axis=1)
    mask = np.zeros(frame.depth_m.size, np.bool_)
    mask[inside] = np.isin(grid.keys(points[inside].astype(np.float32)), keys)
    if np.count_nonzero(mask) >= _MIN_PIXELS:
        yield mask.reshape(frame.depth_m.shape)


def _error(rgb: ndarray, frame: Frame, mask: Bool[ndarray, "h w"]) -> float:
    return float(np.mean(np.abs(rgb[mask] - frame.rgb[mask] / np.float32(255.0))))
