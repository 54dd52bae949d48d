"""Scenes of a study: training frames with relevance masks, and held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Region, RelevanceMap
from gausslite.mission.settings import SceneInfo
from gausslite.perception.relevance import RegionRelevanceEstimator, RelevanceEstimate, RelevanceEstimator
from gausslite_evaluation.views import HeldOutView


class UnseenRegionError(DatasetError):
    """No held-out view shows enough of the task's region to score a map."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A task and its frames in memory: every trial on the scene gets the same frames and masks."""

    task: str
    training: Sequence[Frame]
    masks: Sequence[RelevanceMap]
    held_out: Sequence[HeldOutView]
    info: SceneInfo

    @property
    def roi_share(self) -> float:
        """Region's share of the pixels, over the held-out views that show it."""
        shares = [float(view.roi.mean()) for view in self.held_out if view.roi.any()]
        return float(np.mean(shares)) if shares else 0.0


class RecordedRelevanceEstimator(RelevanceEstimator):
    """A RelevanceEstimator that returns each training frame's precomputed mask, at no cost for any policy."""

    def __init__(self, scene: Scene) -> None:
        # not by pose: frames of equal pose differ in holes and moving objects. Not by frame: a loop moves later frames
        self._masks = {frame.index: mask for frame, mask in zip(scene.training, scene.masks, strict=True)}
        if len(self._masks) < len(scene.training):
            raise InvalidInputError(f"{scene.task!r}: expected frames with different indices, got some twice")

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return the ground-truth mask."""
        del rendered_depth_m
        return RelevanceEstimate(self._masks[frame.index])


def make_scene(
    task: str,
    training: Sequence[Frame],
    held_out: Sequence[HeldOutView],
    regions: Sequence[Region],
    info: SceneInfo,
) -> Scene:
    """Return the scene of the frames and views that have depth. Raises DatasetError if none has."""
    usable = [frame for frame in training if not frame.defect]
    views = [view for view in held_out if not view.frame.defect]
    if not usable or not views:
        counts = f"{len(usable)} and {len(views)}"
        raise DatasetError(f"{task!r}: expected training frames and held-out views with depth, got {counts}")
    estimator = RegionRelevanceEstimator(regions)
    return Scene(task, usable, [estimator.estimate(frame).relevance for frame in usable], views, info)
