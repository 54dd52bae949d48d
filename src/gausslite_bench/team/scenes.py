"""Scenes for a team: each agent has its own frames and task, in a simulated home or in parts of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import Region, RelevanceMap
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite_bench.quality.home_tasks import HOME_TASKS, HomeTask
from gausslite_bench.quality.real_scenes import RealScenePlan
from gausslite_evaluation.views import HeldOutView

_HELD_OUT_TRAJECTORY = 2
_WALKS = ((0, 0), (1, 0), (0, 3), (1, 3))
"""Trajectory of each agent, and frames beyond the stated number: a second robot on the same way sees other views."""


@dataclass(frozen=True, slots=True, eq=False)
class AgentScene:
    """One agent's task with its ground-truth objects, and the agent's frames with the task's masks."""

    agent_id: str
    task: str
    objects: tuple[str, ...]
    frames: Sequence[Frame]
    masks: Sequence[RelevanceMap]


@dataclass(frozen=True, slots=True, eq=False)
class TeamScene:
    """The agents, and held-out views with the union of their tasks' regions."""

    name: str
    agents: tuple[AgentScene, ...]
    views: Sequence[HeldOutView]


@dataclass(frozen=True, slots=True)
class HomeTeamPlan:
    """A team in one home: agent i has the i-th of the home's tasks, in turn, and its own views of the home."""

    home: int
    agents: int = 2
    frames: int = 60
    views: int = 16

    def __post_init__(self) -> None:
        _require_agents(self.agents)
        if not any(task.home == self.home for task in HOME_TASKS):
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
        """Return the scene at (width_px, height_px). Raises DatasetError, InvalidInputError."""
        tasks = [task for task in HOME_TASKS if task.home == self.home]
        chosen = [tasks[i % len(tasks)] for i in range(self.agents)]
        agents = tuple(self._agent_scene(f"agent-{i}", task, _WALKS[i], size) for i, task in enumerate(chosen))
        held_out = open_source(f"{self._spec(_HELD_OUT_TRAJECTORY, self.views, size)}&noise=0&exposure=0")
        names = tuple(dict.fromkeys(name for task in chosen for name in task.objects))
        regions = choose_regions(held_out.regions(), names)
        views = [HeldOutView.of(held_out.frame(i), regions) for i in range(len(held_out))]
        return TeamScene(self.name, agents, [view for view in views if not view.frame.defect])

    def _agent_scene(self, agent_id: str, task: HomeTask, walk: tuple[int, int], size: tuple[int, int]) -> AgentScene:
        trajectory, more_frames = walk
        source = open_source(self._spec(trajectory, self.frames + more_frames, size))
        frames = [frame for frame in (source.frame(i) for i in range(len(source))) if not frame.defect]
        return agent_scene(agent_id, task.task, task.objects, frames, source.regions())

    def _spec(self, trajectory: int, frames: int, size: tuple[int, int]) -> str:
        return f"sim:home-{self.home}?seed=0&trajectory={trajectory}&frames={frames}&size={size[0]}x{size[1]}"


@dataclass(frozen=True, slots=True)
class RecordingTeamPlan:
    """A team in one recording: agent i has the i-th of equal parts in time, and the i-th kind of object, in turn."""

    kinds: tuple[RealScenePlan, ...]
    agents: int = 2

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
        """Return the scene at (width_px, height_px). Raises DatasetError, InvalidInputError."""
        chosen = [self.kinds[i % len(self.kinds)] for i in range(self.agents)]
        names = tuple(dict.fromkeys(name for plan in chosen for name in plan.objects))
        scene = replace(self.kinds[0], objects=names).load(size)
        count = len(scene.training)
        agents = []
        for i, plan in enumerate(chosen):
            part = scene.training[i * count // self.agents : (i + 1) * count // self.agents]
            agents.append(agent_scene(f"agent-{i}", plan.task, plan.objects, part, scene.info.regions))
        return TeamScene(self.name, tuple(agents), scene.held_out)


TeamPlan = HomeTeamPlan | RecordingTeamPlan
"""Description of a team's scene before its frames are loaded."""


def agent_scene(
    agent_id: str, task: str, objects: tuple[str, ...], frames: Sequence[Frame], regions: Mapping[str, Region]
) -> AgentScene:
    """Return the agent's scene, with the masks of its objects. Raises DatasetError for an object without a region."""
    estimator = RegionRelevanceEstimator(choose_regions(regions, objects))
    masks = [estimator.estimate(frame).relevance for frame in frames]
    return AgentScene(agent_id, task, objects, frames, masks)


def _require_agents(count: int) -> None:
    if not 2 <= count <= len(_WALKS):
        raise InvalidInputError(f"agents: expected 2 to {len(_WALKS)}, got {count}")
