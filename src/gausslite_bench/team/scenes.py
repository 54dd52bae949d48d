"""Scenes for a team in a simulated home: each agent has its own trajectory and task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.region import Region
from gausslite.domain.relevance import RelevanceMap
from gausslite.evaluation.views import HeldOutView
from gausslite.perception.fixed_relevance import RegionRelevanceEstimator
from gausslite_bench.quality.home_tasks import HOME_TASKS, HomeTask

_HELD_OUT_TRAJECTORY = 2
_TRAJECTORIES = (0, 1, 3, 4)
_MAX_FRAMES = 10_000
MAX_AGENTS = len(_TRAJECTORIES)


@dataclass(frozen=True, slots=True, eq=False)
class AgentScene:
    """One agent's task and its frames with the task's masks."""

    agent_id: str
    task: HomeTask
    frames: Sequence[Frame]
    masks: Sequence[RelevanceMap]


@dataclass(frozen=True, slots=True, eq=False)
class TeamScene:
    """The agents, and held-out views with the union of their tasks' regions."""

    name: str
    agents: tuple[AgentScene, ...]
    views: Sequence[HeldOutView]


@dataclass(frozen=True, slots=True)
class TeamPlan:
    """A team in one home: agent i has the i-th of the home's tasks, in turn, on its own trajectory."""

    home: int
    agents: int = 2
    frames: int = 60
    views: int = 16

    def __post_init__(self) -> None:
        if not 2 <= self.agents <= MAX_AGENTS:
            raise InvalidInputError(f"agents: expected 2 to {MAX_AGENTS}, got {self.agents}")
        for name in ("frames", "views"):
            if not 1 <= getattr(self, name) <= _MAX_FRAMES:
                raise InvalidInputError(f"{name}: expected 1 to {_MAX_FRAMES}, got {getattr(self, name)}")
        if not any(task.home == self.home for task in HOME_TASKS):
            raise InvalidInputError(f"homes: expected 1 to 8, got {self.home}")

    @property
    def name(self) -> str:
        """Such as home-3 x 2."""
        return f"home-{self.home} x {self.agents}"

    def load(self, size: tuple[int, int]) -> TeamScene:
        """Return the scene at (width_px, height_px). Raises DatasetError, InvalidInputError."""
        tasks = [task for task in HOME_TASKS if task.home == self.home]
        chosen = [tasks[i % len(tasks)] for i in range(self.agents)]
        agents = tuple(self._agent_scene(f"agent-{i}", task, _TRAJECTORIES[i], size) for i, task in enumerate(chosen))
        held_out = open_source(f"{self._spec(_HELD_OUT_TRAJECTORY, self.views, size)}&noise=0&exposure=0")
        names = tuple(dict.fromkeys(name for task in chosen for name in task.objects))
        regions = choose_regions(held_out.regions(), names)
        views = [HeldOutView.of(held_out.frame(i), regions) for i in range(len(held_out))]
        return TeamScene(self.name, agents, [view for view in views if view.frame.has_depth])

    def regions_of_first_task(self, size: tuple[int, int]) -> list[Region]:
        """Return the regions of the first agent's task."""
        task = next(task for task in HOME_TASKS if task.home == self.home)
        return list(choose_regions(open_source(self._spec(0, self.frames, size)).regions(), task.objects))

    def _agent_scene(self, agent_id: str, task: HomeTask, trajectory: int, size: tuple[int, int]) -> AgentScene:
        source = open_source(self._spec(trajectory, self.frames, size))
        frames = [frame for frame in (source.frame(i) for i in range(len(source))) if frame.has_depth]
        estimator = RegionRelevanceEstimator(choose_regions(source.regions(), task.objects))
        return AgentScene(agent_id, task, frames, [estimator.estimate(frame).relevance for frame in frames])

    def _spec(self, trajectory: int, frames: int, size: tuple[int, int]) -> str:
        return f"sim:home-{self.home}?seed=0&trajectory={trajectory}&frames={frames}&size={size[0]}x{size[1]}"
