"""Scenes in simulated homes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mission.settings import SceneInfo
from gausslite_bench.quality.home_tasks import HomeTask
from gausslite_bench.quality.scenes import Scene, make_scene
from gausslite_evaluation.views import HeldOutView

_TRAINING_TRAJECTORIES = (0, 1)
_HELD_OUT_TRAJECTORY = 2
_FIRST_TRAJECTORY_SHARE = 2 / 3


@dataclass(frozen=True, slots=True)
class HomeScenePlan:
    """A task in its simulated home: two training trajectories with sensor noise, held-out views without noise."""

    pair: HomeTask
    frames: int = 60
    views: int = 24
    seed: int = 0

    @property
    def name(self) -> str:
        """Such as home-3-search."""
        return self.pair.name

    @property
    def task(self) -> str:
        """The task's sentence."""
        return self.pair.task

    @property
    def pose_prior(self) -> PoseExposurePrior:
        """Poses and exposures are exact."""
        return PoseExposurePrior()

    def settings(self) -> Mapping[str, object]:
        """Return the trajectories, the task and its objects."""
        return {
            **self.training_settings(),
            "held_out": self._held_out_spec(),
            "task": self.task,
            "objects": list(self.pair.objects),
        }

    def training_settings(self) -> Mapping[str, object]:
        """Return the training trajectories."""
        return {"specs": self._training_specs()}

    def load(self, size: tuple[int, int]) -> Scene:
        """Return the scene; the training trajectories follow each other as one mission."""
        walks = [_walk(f"{spec}&size={size[0]}x{size[1]}") for spec in (*self._training_specs(), self._held_out_spec())]
        *training, held_out = (frames for _, frames in walks)
        source = walks[0][0]
        regions = choose_regions(source.regions(), self.pair.objects)
        views = [HeldOutView.of(frame, regions) for frame in held_out]
        # one mission: each walk counts its own frames from 0
        frames = [replace(frame, index=i) for i, frame in enumerate(frame for walk in training for frame in walk)]
        return make_scene(self.task, frames, views, regions, SceneInfo.of(source))

    def _training_specs(self) -> list[str]:
        first = max(1, round(_FIRST_TRAJECTORY_SHARE * self.frames))
        counts = (first, self.frames - first)
        return [self._spec(*row) for row in zip(_TRAINING_TRAJECTORIES, counts, strict=True)]

    def _held_out_spec(self) -> str:
        return f"{self._spec(_HELD_OUT_TRAJECTORY, self.views)}&noise=0&exposure=0"

    def _spec(self, trajectory: int, frames: int) -> str:
        return f"sim:home-{self.pair.home}?seed={self.seed}&trajectory={trajectory}&frames={frames}"


@lru_cache(maxsize=len(_TRAINING_TRAJECTORIES) + 1)
def _walk(spec: str) -> tuple[Source, tuple[Frame, ...]]:
    """Return a source with its frames; cached, because a home's tasks follow each other and have the same walks."""
    source = open_source(spec)
    return source, tuple(source.frame(i) for i in range(len(source)))
