"""Scenes for a team: each agent has its own frames and task, in a simulated home or in parts of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mission.settings import SceneInfo
from gausslite_bench.quality.home_tasks import HomeTask, home_tasks
from gausslite_bench.quality.real_scenes import RealScenePlan
from gausslite_bench.quality.scenes import Scene, make_scene
from gausslite_evaluation.views import HeldOutView

TeamScene = Mapping[str, Scene]
"""The scene of each agent by its id; their held-out views are the same, with the union of their tasks' regions."""
_HELD_OUT_TRAJECTORY = 2
_WALKS = ((0, 0), (1, 0), (0, 3), (1, 3))
"""Trajectory of each agent, and frames beyond the stated number: a second robot on the same way sees other views."""


@dataclass(frozen=True, slots=True)
class HomeTeamPlan:
    """A team in one home: agent i has the i-th of the home's tasks, in turn, and its own views of the home."""

    home: int
    agents: int = 2
    frames: int = 60
    views: int = 16

    def __post_init__(self) -> None:
        _require_agents(self.agents)
        if not any(task.home == self.home for task in home_tasks()):
            raise InvalidInputError(f"homes: expected 1 to 8, got {self.home}")

    @property
    def name(self) -> str:
        """Such as home-3 x 2."""
        return f"home-{self.home} x {self.agents}"

    @property
    def pose_prior(self) -> PoseExposurePrior:
        """Poses and exposures are exact."""
        return PoseExposurePrior()

    def load(self, size: tuple[int, int]) -> TeamScene:
        """Return the scenes at (width_px, height_px). Raises DatasetError, InvalidInputError."""
        tasks = [task for task in home_tasks() if task.home == self.home]
        chosen = [tasks[i % len(tasks)] for i in range(self.agents)]
        held_out = open_source(f"{self._spec(_HELD_OUT_TRAJECTORY, self.views, size)}&noise=0&exposure=0")
        names = tuple(dict.fromkeys(name for task in chosen for name in task.objects))
        regions = choose_regions(held_out.regions(), names)
        views = [HeldOutView.of(held_out.frame(i), regions) for i in range(len(held_out))]
        return {f"agent-{i}": self._scene(task, _WALKS[i], size, views) for i, task in enumerate(chosen)}

    def _scene(
        self, task: HomeTask, walk: tuple[int, int], size: tuple[int, int], views: Sequence[HeldOutView]
    ) -> Scene:
        trajectory, more_frames = walk
        source = open_source(self._spec(trajectory, self.frames + more_frames, size))
        frames = [source.frame(i) for i in range(len(source))]
        regions = choose_regions(source.regions(), task.objects)
        return make_scene(task.task, frames, views, regions, SceneInfo.of(source))

    def _spec(self, trajectory: int, frames: int, size: tuple[int, int]) -> str:
        return f"sim:home-{self.home}?seed=0&trajectory={trajectory}&frames={frames}&size={size[0]}x{size[1]}"


@dataclass(frozen=True, slots=True)
class RecordingTeamPlan:
    """A recorded team: agent i has the i-th recording, and the i-th kind of object, in turn.

    recordings: of each agent, in one world frame; empty if the agents have equal parts in time of one recording.
    """

    kinds: tuple[RealScenePlan, ...]
    agents: int = 2
    recordings: tuple[RealScenePlan, ...] = ()

    def __post_init__(self) -> None:
        _require_agents(self.agents)

    @property
    def name(self) -> str:
        """Such as redkitchen-mug-chair x 2."""
        return f"{'-'.join([self.kinds[0].name, *(plan.kind for plan in self.kinds[1 : self.agents])])} x {self.agents}"

    @property
    def pose_prior(self) -> PoseExposurePrior:
        """That of the recording."""
        return self.kinds[0].pose_prior

    def load(self, size: tuple[int, int]) -> TeamScene:
        """Return the scenes at (width_px, height_px). Raises UnseenRegionError, DatasetError, InvalidInputError."""
        chosen = [self.kinds[i % len(self.kinds)] for i in range(self.agents)]
        names = tuple(dict.fromkeys(name for plan in chosen for name in plan.objects))
        plans = [replace(plan, objects=names) for plan in self.recordings or self.kinds[:1]]
        scenes = [plan.load(size, is_part_of_team=True) for plan in plans]
        info, held_out = scenes[0].info, [view for scene in scenes for view in scene.held_out]
        plans[0].require_shown(held_out)
        parts = [scene.training for scene in scenes]
        if not self.recordings:
            count = len(parts[0])
            parts = [parts[0][i * count // self.agents : (i + 1) * count // self.agents] for i in range(self.agents)]
        return {
            f"agent-{i}": make_scene(plan.task, part, held_out, choose_regions(info.regions, plan.objects), info)
            for i, (plan, part) in enumerate(zip(chosen, parts, strict=True))
        }


TeamPlan = HomeTeamPlan | RecordingTeamPlan
"""Description of a team's scene before its frames are loaded."""


def _require_agents(count: int) -> None:
    if not 2 <= count <= len(_WALKS):
        raise InvalidInputError(f"agents: expected 2 to {len(_WALKS)}, got {count}")
