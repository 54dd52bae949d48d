"""Gain of the task policy over uniform mapping against one budget at a time: Gaussians, image size or iterations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, pstdev

from gausslite.mapping.policies import TASK, UNIFORM
from gausslite_bench.quality.study import FinishedTrial
from gausslite_bench.quality.trials import TrialBudget, Variant

VARIANTS = (Variant(TASK, TASK), Variant(UNIFORM, UNIFORM))


@dataclass(frozen=True, slots=True)
class BudgetPoint:
    """Budget of both policies: the cap on Gaussians, the image size (width_px, height_px), iterations per frame."""

    max_gaussians: int
    size: tuple[int, int]
    iterations: int

    @property
    def trial_budget(self) -> TrialBudget:
        """The budget without the image size."""
        return TrialBudget(self.max_gaussians, iterations=self.iterations)

    def __str__(self) -> str:
        """Return the budget as text."""
        return f"{self.max_gaussians} Gaussians, {self.size[0]}x{self.size[1]}, {self.iterations} iterations"


@dataclass(frozen=True, slots=True)
class BudgetAxes:
    """The values of each budget. While one varies, the others have their first value."""

    caps: Sequence[int]
    sizes: Sequence[tuple[int, int]]
    iterations: Sequence[int]

    def points(self) -> dict[str, list[BudgetPoint]]:
        """Return the points of each axis that has several values, ascending; with one value each, the single point."""
        cap, size, iterations = self.caps[0], self.sizes[0], self.iterations[0]
        axes = {
            "Gaussians": [BudgetPoint(gaussian_cap, size, iterations) for gaussian_cap in sorted(set(self.caps))],
            "image size": [BudgetPoint(cap, image_size, iterations) for image_size in sorted(set(self.sizes))],
            "iterations": [BudgetPoint(cap, size, iteration) for iteration in sorted(set(self.iterations))],
        }
        return {name: points for name, points in axes.items() if len(points) > 1} or {"budget": axes["Gaussians"]}

    def all_points(self) -> list[BudgetPoint]:
        """Return every point once; those of one image size are consecutive."""
        points = dict.fromkeys(point for listed in self.points().values() for point in listed)
        return sorted(points, key=lambda point: point.size)


@dataclass(frozen=True, slots=True)
class TaskGain:
    """Task policy minus uniform mapping at one point, in dB: means over scenes and seeds.

    Views are fitted on real sequences. roi_spread: standard deviation over the seeds of the mean over the scenes.
    worst_scene: smallest gain of a scene, mean over the seeds. ms: milliseconds per frame of task and uniform.
    """

    roi: float
    roi_spread: float
    worst_scene: float
    full: float
    roi_psnr: float
    ms: tuple[float, float]


def task_gain(finished: Sequence[FinishedTrial]) -> TaskGain | None:
    """Return the gain over the trials of one point; None if no view shows a region."""
    roi = _differences(finished, "roi_psnr")
    if not roi:
        return None
    seeds, scenes = sorted({seed for _, seed in roi}), sorted({scene for scene, _ in roi})
    by_seed = [fmean(gain for (_, seed), gain in roi.items() if seed == chosen) for chosen in seeds]
    by_scene = [fmean(gain for (scene, _), gain in roi.items() if scene == chosen) for chosen in scenes]
    of_task = [trial for trial in finished if trial.trial.variant.label == TASK]
    costs = [
        fmean(trial.result.ms_per_frame for trial in finished if trial.trial.variant == variant) for variant in VARIANTS
    ]
    return TaskGain(
        roi=fmean(by_seed),
        roi_spread=pstdev(by_seed),
        worst_scene=min(by_scene),
        full=fmean(_differences(finished, "full_psnr").values()),
        roi_psnr=fmean(value for trial in of_task if (value := _score(trial, "roi_psnr")) is not None),
        ms=(costs[0], costs[1]),
    )


def budget_table(axes: BudgetAxes, gains: Mapping[BudgetPoint, TaskGain]) -> str:
    """Return one table with a row per point of each axis."""
    rows = [
        "| varied | budget | task, ROI PSNR | ROI gain [dB] | least scene | full gain [dB] | ms task, uniform |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, points in axes.points().items():
        for point in (known for known in points if known in gains):
            gain = gains[point]
            rows.append(
                f"| {name} | {point} | {gain.roi_psnr:.2f} | {gain.roi:+.2f} ± {gain.roi_spread:.2f} | "
                f"{gain.worst_scene:+.2f} | {gain.full:+.2f} | {gain.ms[0]:.0f}, {gain.ms[1]:.0f} |"
            )
    return "\n".join(rows) + "\n"


def budget_curves(
    axes: BudgetAxes, gains: Mapping[BudgetPoint, TaskGain]
) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """Return a panel per axis with the lines "region" and "full image"; an image size counts in thousand pixels."""
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for name, points in axes.points().items():
        shown = [point for point in points if point in gains]
        title = "gain against image size, in 1000 pixels" if name == "image size" else f"gain against {name}"
        panels[title] = {
            "region": [(_position(name, point), gains[point].roi) for point in shown],
            "full image": [(_position(name, point), gains[point].full) for point in shown],
        }
    return panels


def _position(axis: str, point: BudgetPoint) -> float:
    if axis == "image size":
        return point.size[0] * point.size[1] / 1000.0
    return float(point.iterations if axis == "iterations" else point.max_gaussians)


def _score(finished: FinishedTrial, field: str) -> float | None:
    scores = finished.result.scores if finished.result.fitted is None else finished.result.fitted
    value: float | None = getattr(scores, field)
    return value


def _differences(finished: Sequence[FinishedTrial], field: str) -> dict[tuple[str, int], float]:
    """Return task minus uniform by scene and seed."""
    by_variant: dict[str, dict[tuple[str, int], float]] = {variant.label: {} for variant in VARIANTS}
    for trial in finished:
        value = _score(trial, field)
        if value is not None:
            by_variant[trial.trial.variant.label][trial.trial.plan.name, trial.trial.seed] = value
    task, uniform = (by_variant[variant.label] for variant in VARIANTS)
    return {key: task[key] - uniform[key] for key in task.keys() & uniform.keys()}
