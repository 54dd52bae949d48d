"""Choose what a refinement trains on: keyframes that agree with the vote, and each agent's region in them.

The fused map usually holds only the tasks' voxels. So a keyframe is compared only with pixels that the map explains:
inside the footprint of the fused map, and not where the measured surface occludes it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int16
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame, without_depth_edges
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import find_in
from gausslite.mapping.window_view import roi_weights
from gausslite.render.rasterizer import FULL_FRAME, Rasterizer, Subset, TrainingView
from gausslite_refinement.refine_input import RefineInput

_FOOTPRINT_ALPHA = 0.5
_DEPTH_M, _DEPTH_SHARE, _COLOUR = 0.05, 0.05, 0.1
"""Measured and rendered surface agree within this distance plus this share of the depth, and this mean difference of
the channels. In the simulated home 84 to 98 % of a keyframe's pixels agree, 10 to 50 % with its pose 0.1 m off."""
_MIN_AGREEMENT, _MIN_ALONE, _MIN_OF_BEST = 0.05, 0.5, 0.75
"""Least agreement; the same where no agent of the vote has keyframes; and least share of the median of the agent that
agrees best, because a coarse map agrees less with every keyframe."""
_UNEXPLAINED, BACKGROUND = -2, -1


@dataclass(frozen=True, slots=True, eq=False)
class RefineView:
    """A keyframe that shows some of the map. agreement: share of the pixels that it and the vote show alike.

    region: of each pixel, the number of the agent in whose region its surface lies, -1 outside all regions, -2 if the
    map does not explain the pixel.
    """

    agent_id: str
    frame: Frame
    agreement: float
    region: Int16[ndarray, "h w"]

    @property
    def T_camera_world(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - a transform names both frames
        """The inverse of the keyframe's pose."""
        return inverse(self.frame.T_world_camera)

    def prepare(
        self, rasterizer: Rasterizer, region: int, context_weight: float, depth_edge_px: int
    ) -> tuple[TrainingView, Subset, float]:
        """Return the view for steps on one region and its surroundings, or on all that the map explains (BACKGROUND).

        Returns it with the tiles to render and their share of the image.
        """
        explained, subset, share = (self.region > _UNEXPLAINED).astype(np.float32), FULL_FRAME, 1.0
        if region != BACKGROUND:
            tiles, weights = roi_weights((self.region == region).astype(np.float32), context_weight)
            explained, subset, share = explained * weights, Subset(tiles), float(tiles.mean())
        frame, depth_m = self.frame, without_depth_edges(self.frame.depth_m, depth_edge_px)
        return rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, explained, frame.motion), subset, share


def views_of(rows: Float32[ndarray, "n 16"], vote: RefineInput, rasterizer: Rasterizer) -> list[RefineView]:
    """Return the keyframes that show some of the map, which has these rows."""
    keys = np.concatenate([np.zeros(0, np.int64), *vote.regions.values()])
    owners = np.repeat(np.arange(len(vote.regions), dtype=np.int16), [len(own) for own in vote.regions.values()])
    order = np.argsort(keys)
    keys, owners = keys[order], np.append(owners[order], np.int16(BACKGROUND))
    views = []
    for agent_id, frame in ((keyframe.agent_id, keyframe.frame) for keyframe in vote.keyframes):
        rendering = rasterizer.forward(rows, frame.camera, inverse(frame.T_world_camera), motion=frame.motion)
        surface_m = rendering.expected_depth_m(_FOOTPRINT_ALPHA)
        behind_m = np.where(frame.depth_m > 0, frame.depth_m - surface_m, 0.0)
        tolerance_m = _DEPTH_M + _DEPTH_SHARE * surface_m
        explained = (surface_m > 0) & (behind_m >= -tolerance_m)
        if frame.left_out is not None:
            explained &= ~frame.left_out
        if not explained.any():
            continue
        difference = np.abs(np.clip(rendering.rgb, 0.0, 1.0) - frame.rgb / np.float32(255.0)).mean(axis=2)
        agrees = (behind_m <= tolerance_m) & (difference <= _COLOUR)
        points_m = back_project(surface_m, frame.camera)[explained]
        of_pixel = np.full(surface_m.shape, _UNEXPLAINED, np.int16)
        found = vote.grid.keys(transform_points(frame.T_world_camera, points_m).astype(np.float32))
        of_pixel[explained] = owners[find_in(keys, found)]
        views.append(RefineView(agent_id, frame, float(agrees[explained].mean()), of_pixel))
    return views


def agreeing(views: Sequence[RefineView], contributors: Collection[str]) -> tuple[list[RefineView], tuple[str, ...]]:
    """Return the views that agree with the vote, and a line for each agent of which some are left out.

    contributors: the agents with voxels in the vote. They set the standard, if they have keyframes.
    """
    by_agent: dict[str, list[float]] = {}
    for view in views:
        by_agent.setdefault(view.agent_id, []).append(view.agreement)
    medians = {name: float(np.median(own)) for name, own in by_agent.items()}
    standard = [median for name, median in medians.items() if name in contributors]
    best = max(standard or medians.values(), default=0.0)
    least = max(_MIN_AGREEMENT if standard else _MIN_ALONE, _MIN_OF_BEST * best)
    left_out = Counter(view.agent_id for view in views if view.agreement < least)
    lines = (f"{name}: {count} of {len(by_agent[name])} keyframes" for name, count in sorted(left_out.items()))
    return [view for view in views if view.agreement >= least], tuple(lines)
