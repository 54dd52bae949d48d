"""Tables of a study: means and standard deviations over seeds, as JSON and as Markdown in the paper's layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from statistics import fmean, pstdev

from gausslite_bench.quality.study import FinishedTrial
from gausslite_bench.quality.trials import TrialBudget
from gausslite_evaluation.lpips import NAME as LPIPS_NAME


class ViewFit(StrEnum):
    """What was fitted before a view was scored, as the field of TrialResult that holds the scores."""

    RAW = "scores"
    FITTED = "fitted"
    REGION_FITTED = "region_fitted"


@dataclass(frozen=True, slots=True)
class Metric:
    """A field of MapScores at one kind of view fit; factor converts it to the table's unit."""

    title: str
    field: str
    digits: int
    factor: float = 1.0
    fit: ViewFit = ViewFit.RAW

    @property
    def name(self) -> str:
        """Key in JSON."""
        return self.field if self.fit is ViewFit.RAW else f"{self.fit}_{self.field}"


ROI_METRICS = (
    Metric("PSNR↑", "roi_psnr", 2),
    Metric("SSIM↑", "roi_ssim", 3),
    Metric(f"{LPIPS_NAME}↓", "roi_lpips", 3),
    Metric("depth L1 [cm]↓", "roi_depth_l1_m", 2, 100.0),
    Metric("covered [%]↑", "roi_covered", 1, 100.0),
    Metric("Laplacian ratio↑", "roi_laplacian_ratio", 2),
    Metric("GMSD↓", "roi_gradient_deviation", 3),
)
FULL_METRICS = (
    Metric("PSNR↑", "full_psnr", 2),
    Metric("SSIM↑", "full_ssim", 3),
    Metric(f"{LPIPS_NAME}↓", "full_lpips", 3),
    Metric("depth L1 [cm]↓", "full_depth_l1_m", 2, 100.0),
    Metric("Laplacian ratio↑", "full_laplacian_ratio", 2),
    Metric("GMSD↓", "full_gradient_deviation", 3),
)
ROI_FITTED_METRICS, FULL_FITTED_METRICS = (
    tuple(replace(metric, title=f"{metric.title}, views fitted", fit=ViewFit.FITTED) for metric in metrics[:3])
    for metrics in (ROI_METRICS, FULL_METRICS)
)
FITTED_PSNR = (ROI_FITTED_METRICS[0], FULL_FITTED_METRICS[0])
REGION_FITTED_METRICS = (
    Metric("PSNR, fitted at the region↑", "roi_psnr", 2, fit=ViewFit.REGION_FITTED),
    Metric("Laplacian ratio, fitted at the region↑", "roi_laplacian_ratio", 2, fit=ViewFit.REGION_FITTED),
    Metric("GMSD, fitted at the region↓", "roi_gradient_deviation", 3, fit=ViewFit.REGION_FITTED),
)
RAW_PSNR = (ROI_METRICS[0], FULL_METRICS[0])
_NOT_COMPUTED = "not computed"


@dataclass(frozen=True, slots=True)
class MeanStd:
    """Mean and spread (population standard deviation) over the seeds."""

    mean: float
    spread: float

    def as_text(self, digits: int, factor: float = 1.0) -> str:
        """Return text such as "27.31 ± 0.08"."""
        return f"{factor * self.mean:.{digits}f} ± {factor * self.spread:.{digits}f}"


class StudyResults:
    """Results of a study, indexed by scene, variant and budget."""

    def __init__(self, finished: Sequence[FinishedTrial]) -> None:
        self._finished = list(finished)
        trials = [trial.trial for trial in finished]
        self.scenes = list(dict.fromkeys(trial.plan.name for trial in trials))
        self.variants = list(dict.fromkeys(trial.variant.label for trial in trials))
        self.budgets = list(dict.fromkeys(trial.budget for trial in trials))

    @property
    def finished(self) -> list[FinishedTrial]:
        """All trials of the study."""
        return list(self._finished)

    @property
    def has_fitted(self) -> bool:
        """True if a trial has scores with fitted views."""
        return any(trial.result.fitted is not None for trial in self._finished)

    @property
    def notes(self) -> list[str]:
        """Warnings to print first: the number of trials from other code."""
        others, count = sum(trial.from_other_code for trial in self._finished), len(self._finished)
        text = f"**{others} of these {count} trials are from other code: their scores may not be comparable.**"
        return [text] if others else []

    def figure(self, scene: str, variant: str, metric: Metric, budget: TrialBudget) -> MeanStd | None:
        """Return mean and spread over the seeds; None if no trial has the metric."""
        results = [trial.result for trial in self._of(scene, variant, budget)]
        scores = [getattr(result, metric.fit) for result in results]
        values = [getattr(score, metric.field) for score in scores if score is not None]
        known = [value for value in values if value is not None]
        return MeanStd(fmean(known), pstdev(known)) if known else None

    def mean(self, scenes: Sequence[str], variant: str, metric: Metric, budget: TrialBudget) -> float | None:
        """Return the mean over these scenes; None if one of them lacks the metric."""
        figures = [self.figure(scene, variant, metric, budget) for scene in scenes]
        known = [figure.mean for figure in figures if figure is not None]
        return fmean(known) if known and len(known) == len(figures) else None

    def margin(self, scene: str, metric: Metric, budget: TrialBudget) -> float | None:
        """Return the first variant's mean minus the best other's; None without a second variant or the metric."""
        first, *others = (self.figure(scene, variant, metric, budget) for variant in self.variants)
        known = [other.mean for other in others if other is not None]
        return first.mean - max(known) if first is not None and known else None

    def margins(self, metric: Metric, budget: TrialBudget) -> list[float]:
        """Return the margins of the scenes that have the metric."""
        return [m for scene in self.scenes if (m := self.margin(scene, metric, budget)) is not None]

    def roi_share(self, scene: str) -> float:
        """Return the region's share of the held-out views' pixels."""
        return next(trial.result.roi_share for trial in self._finished if trial.trial.plan.name == scene)

    def shown(self, scene: str) -> str:
        """Return the region's visibility in the held-out views, such as "0.7% in 4 of 5 views"."""
        scores = next(trial.result.scores for trial in self._finished if trial.trial.plan.name == scene)
        return f"{self.roi_share(scene):.1%} in {scores.n_roi_views} of {scores.n_views} views"

    def task(self, scene: str) -> str:
        """Return the scene's task."""
        return next(trial.trial.plan.task for trial in self._finished if trial.trial.plan.name == scene)

    def cost_text(self, variant: str, budget: TrialBudget) -> str:
        """Return the mean iterations and milliseconds per frame and sizes of the maps, over all scenes and seeds."""
        results = [trial.result for scene in self.scenes for trial in self._of(scene, variant, budget)]
        columns = [(r.iterations_mean, r.ms_per_frame, r.gaussians, r.map_bytes / 1e3) for r in results]
        iterations, ms, gaussians, kilobytes = (fmean(column) for column in zip(*columns, strict=True))
        return f"{iterations:.1f} iterations and {ms:.0f} ms per frame, {gaussians:.0f} Gaussians, {kilobytes:.0f} kB"

    def as_json(self) -> dict[str, object]:
        """Return all means and all trials as JSON values."""
        return {
            "budgets": [asdict(budget) for budget in self.budgets],
            "scenes": [self._scene_as_json(scene) for scene in self.scenes],
            "summary": [self._summary(budget) for budget in self.budgets],
        }

    def _of(self, scene: str, variant: str, budget: TrialBudget) -> list[FinishedTrial]:
        return [
            trial
            for trial in self._finished
            if (trial.trial.plan.name, trial.trial.variant.label, trial.trial.budget) == (scene, variant, budget)
        ]

    def _scene_as_json(self, scene: str) -> dict[str, object]:
        fitted = (*ROI_FITTED_METRICS, *FULL_FITTED_METRICS, *REGION_FITTED_METRICS)
        metrics = (*ROI_METRICS, *FULL_METRICS, *fitted)
        results = []
        for budget in self.budgets:
            for variant in self.variants:
                figures = {metric.name: self.figure(scene, variant, metric, budget) for metric in metrics}
                results.append(
                    {
                        "variant": variant,
                        "equal": str(budget.equal),
                        **{name: None if figure is None else asdict(figure) for name, figure in figures.items()},
                        "trials": [
                            {"seed": trial.trial.seed, "other_code": trial.from_other_code, **trial.result.as_json()}
                            for trial in self._of(scene, variant, budget)
                        ],
                    }
                )
        return {"scene": scene, "task": self.task(scene), "roi_share": self.roi_share(scene), "results": results}

    def _summary(self, budget: TrialBudget) -> dict[str, object]:
        metrics = (*RAW_PSNR, ROI_METRICS[1], *FITTED_PSNR)
        known = {metric.name: self.margins(metric, budget) for metric in metrics}
        return {
            "equal": str(budget.equal),
            "ahead_in": sum(margin > 0 for margin in known["roi_psnr"]),
            "scenes": len(known["roi_psnr"]),
            "mean_margin": {name: fmean(listed) if listed else None for name, listed in known.items()},
        }


def quality_table(results: StudyResults) -> str:
    """Return the comparison of policies: per place as in the paper's Replica table, per pair, and a summary."""
    blocks = results.notes
    roi_fitted = (*ROI_FITTED_METRICS, *REGION_FITTED_METRICS) if results.has_fitted else ()
    full_fitted = FULL_FITTED_METRICS if results.has_fitted else ()
    for budget in results.budgets:
        blocks += [
            f"## Equal {budget.equal} ({budget}), at most {budget.max_gaussians} Gaussians",
            "Inside the task's ground-truth mask (mean over a place's tasks):",
            _by_place(results, (*ROI_METRICS, *roi_fitted), budget),
            "Over the full image:",
            _by_place(results, (*FULL_METRICS, *full_fitted), budget),
            "Per pair, ROI PSNR in dB (mean ± standard deviation over the seeds):",
            _by_scene(results, RAW_PSNR, budget),
        ]
        if results.has_fitted:
            blocks += ["The same with fitted poses and exposures:", _by_scene(results, FITTED_PSNR, budget)]
        blocks.append(_summary_text(results, budget))
    return "\n\n".join(blocks) + "\n"


def ablation_table(results: StudyResults) -> str:
    """Return one row per component: ROI and full PSNR at every budget, per scene and on average."""
    blocks = results.notes
    for scene in results.scenes:
        title = f"## {scene}: {results.task(scene)} (ROI {results.shown(scene)})"
        blocks += [title, _by_component(results, [scene])]
    if len(results.scenes) > 1:
        blocks += [f"## Mean over these {len(results.scenes)} scenes", _by_component(results, results.scenes)]
    return "\n\n".join(blocks) + "\n"


def _by_component(results: StudyResults, scenes: Sequence[str]) -> str:
    """Return the rows of the ablation: with the spread for a single scene, with fitted PSNR if all scenes have it."""
    columns = [("ROI PSNR", ROI_METRICS[0]), ("full PSNR", FULL_METRICS[0])]
    if results.mean(scenes, results.variants[0], FITTED_PSNR[1], results.budgets[0]) is not None:
        columns += zip(("ROI PSNR, views fitted", "full PSNR, views fitted"), FITTED_PSNR, strict=True)
    shown = [(metric, budget) for budget in results.budgets for _, metric in columns]
    rows = [["components", *(f"{title}, equal {budget.equal}" for budget in results.budgets for title, _ in columns)]]
    for variant in results.variants:
        if len(scenes) == 1:
            cells = [_text(results.figure(scenes[0], variant, *figure), figure[0]) for figure in shown]
        else:
            cells = [_number(results.mean(scenes, variant, *figure), figure[0]) for figure in shown]
        rows.append([variant, *cells])
    return _markdown(rows)


def _by_place(results: StudyResults, metrics: Sequence[Metric], budget: TrialBudget) -> str:
    places: dict[str, list[str]] = {}
    for scene in results.scenes:
        places.setdefault(scene.rsplit("-", 1)[0], []).append(scene)
    rows = [["policy", "metric", *places, "avg."]]
    for variant in results.variants:
        for metric in metrics:
            columns = [results.mean(scenes, variant, metric, budget) for scenes in (*places.values(), results.scenes)]
            cells = [_number(value, metric) for value in columns]
            rows.append([variant if metric is metrics[0] else "", metric.title, *cells])
    return _markdown(rows)


def _by_scene(results: StudyResults, roi_and_full: tuple[Metric, Metric], budget: TrialBudget) -> str:
    roi, _ = roi_and_full
    rows = [["pair", "task", "ROI", *results.variants, "margin", "full margin"]]
    for scene in results.scenes:
        cells = [_text(results.figure(scene, variant, roi, budget), roi) for variant in results.variants]
        margins = [results.margin(scene, metric, budget) for metric in roi_and_full]
        signed = ["" if margin is None else f"{margin:+.2f}" for margin in margins]
        rows.append([scene, results.task(scene), results.shown(scene), *cells, *signed])
    return _markdown(rows)


def _summary_text(results: StudyResults, budget: TrialBudget) -> str:
    lines = []
    for (roi, full), suffix in ((RAW_PSNR, ""), (FITTED_PSNR, " with views fitted")):
        roi_margins, full_margins = results.margins(roi, budget), results.margins(full, budget)
        if roi_margins:
            wins = f"{sum(margin > 0 for margin in roi_margins)} of {len(roi_margins)}"
            lines.append(
                f"`{results.variants[0]}` exceeds the best other policy in {wins}, by {fmean(roi_margins):+.2f} dB "
                f"inside the mask on average and by {fmean(full_margins):+.2f} dB over the full image{suffix}."
            )
    lines += [f"`{variant}`: {results.cost_text(variant, budget)}." for variant in results.variants]
    return "\n".join(lines)


def _text(figure: MeanStd | None, metric: Metric) -> str:
    return _NOT_COMPUTED if figure is None else figure.as_text(metric.digits, metric.factor)


def _number(value: float | None, metric: Metric) -> str:
    return _NOT_COMPUTED if value is None else f"{metric.factor * value:.{metric.digits}f}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)
