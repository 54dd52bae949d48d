"""Where is the object: errors of the reported positions against ground truth, for one agent and for the team."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.objects import ObjectReport, TeamObject
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import MIN_ROI_PIXELS, Region
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.fusion.objects import find_objects, merge_objects
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.settings import PerceptionSettings
from gausslite.nouns import same_kind
from gausslite_bench.team.scenes import AgentScene, TeamScene
from gausslite_evaluation.views import HeldOutView
from gausslite_language.rules import RuleParser

_CELL_M = 0.02
_MATCH_M = 0.5


@dataclass(frozen=True, slots=True)
class PositionScore:
    """Reports of some agents. shown: objects of the task that a frame of these agents shows.

    errors_m: distance of each found object's centroid to the true one; an object is found if a report of its noun is
    within half a metre. others: reported objects of these nouns without one of the task there.
    """

    scene: str
    task: str
    agents: int
    shown: int
    errors_m: tuple[float, ...]
    others: int

    @property
    def row(self) -> str:
        """The table row."""
        errors = [100 * error_m for error_m in self.errors_m]
        figures = f"{fmean(errors):.1f} | {max(errors):.1f}" if errors else "- | -"
        found = f"{len(errors)} of {self.shown}"
        return f"| {self.scene} | {self.task} | {self.agents} | {found} | {figures} | {self.others} |"


def measure_positions(
    scene: TeamScene, perception: PerceptionSettings, on_frame: Callable[[], None]
) -> list[PositionScore]:
    """Run perception on each agent's frames; score the first agent's objects, and those of the team.

    Only the objects of the first agent's task count. Raises GaussLiteError.
    """
    factory = EstimatorFactory(perception, lambda: scene.info)
    first = scene.agents[0]
    truths = _true_centroids(scene, first.objects)
    reports, shown = {}, set()
    scores = []
    for count, agent in enumerate(scene.agents, start=1):
        reports[agent.agent_id] = _observe(agent, factory, on_frame)
        shown |= _shown_objects(agent, scene, truths)
        if count in (1, len(scene.agents)):
            scores.append(_score(scene.name, first.task, count, reports, {name: truths[name] for name in shown}))
    return scores


def _observe(agent: AgentScene, factory: EstimatorFactory, on_frame: Callable[[], None]) -> ObjectReport:
    graph = RuleParser().parse(agent.task)
    estimator = factory.build(graph)
    for frame in agent.frames:
        estimator.estimate(frame)
        on_frame()
    return ObjectReport(graph, estimator.objects)


def _score(
    scene: str,
    task: str,
    agents: int,
    reports: dict[str, ObjectReport],
    truths: dict[str, Float64[ndarray, "3"]],
) -> PositionScore:
    found = _target_objects(reports, RuleParser().parse(task))
    # the nearest pairs of a reported and a true object first, each once
    distances = sorted(
        (float(np.linalg.norm(np.array(team_object.landmark.centroid_m) - centroid)), i, name)
        for i, team_object in enumerate(found)
        for name, centroid in truths.items()
        if same_kind(team_object.landmark.noun, name)
    )
    errors: dict[str, float] = {}
    used: set[int] = set()
    for distance_m, i, name in distances:
        if distance_m <= _MATCH_M and i not in used and name not in errors:
            errors[name] = distance_m
            used.add(i)
    return PositionScore(scene, task, agents, len(truths), tuple(errors.values()), len(found) - len(used))


def _target_objects(reports: dict[str, ObjectReport], graph: TaskGraph) -> list[TeamObject]:
    objects = {
        found.landmark.object_id: found
        for target in graph.targets
        for found in find_objects(merge_objects(reports), noun_of(target))
    }
    return list(objects.values())


def _true_centroids(scene: TeamScene, names: Sequence[str]) -> dict[str, Float64[ndarray, "3"]]:
    """Return the mean of each object's surface cells of 2 cm in the held-out views; objects out of view are absent."""
    truths = {}
    for name in names:
        [region] = scene.regions([name])
        cells = _surface_cells(region, [view.frame for view in scene.views])
        if len(cells):
            truths[name] = (cells.mean(axis=0) + 0.5) * _CELL_M
    return truths


def _surface_cells(region: Region, frames: Sequence[Frame]) -> Float64[ndarray, "n 3"]:
    cells = [np.zeros((0, 3))]
    for frame in frames:
        mask = HeldOutView.of(frame, [region]).roi & (frame.depth_m > 0)
        points = transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera)[mask])
        cells.append(np.floor(points / _CELL_M))
    return np.unique(np.vstack(cells), axis=0).astype(np.float64)


def _shown_objects(agent: AgentScene, scene: TeamScene, truths: dict[str, Float64[ndarray, "3"]]) -> set[str]:
    def is_shown(name: str) -> bool:
        [region] = scene.regions([name])
        return any(np.count_nonzero(region.mask(frame)) >= MIN_ROI_PIXELS for frame in agent.frames)

    return {name for name in truths if is_shown(name)}


def positions_table(scores: Sequence[PositionScore]) -> str:
    """Return one row per scene and number of agents."""
    lines = [
        "Where is the object: reported centroids against the mean of the 2 cm surface cells in the held-out views. "
        "others: reported objects without one of the task within 0.5 m.",
        "",
        "| scene | task | agents | found | mean error (cm) | largest (cm) | others |",
        "|---|---|---|---|---|---|---|",
        *(score.row for score in scores),
    ]
    return "\n".join(lines) + "\n"
