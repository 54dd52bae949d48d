"""Tables of a study in Markdown: means over the seeds, and over the scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean, pstdev

from gausslite_bench.quality.study import FinishedTrial
from gausslite_bench.quality.trials import TrialBudget, TrialResult
from gausslite_evaluation.lpips import NAME as LPIPS_NAME


@dataclass(frozen=True, slots=True)
class Metric:
    """A field of MapScores; factor converts it to the table's unit."""

    title: str
    field: str
    digits: int
    factor: float = 1.0

    def value(self, result: TrialResult) -> float | None:
        """Return the value in the table's unit; None if the trial does not have it."""
        value = getattr(result.scores, self.field)
        return None if value is None else self.factor * value


_KINDS = (("PSNR↑", "psnr", 2), ("SSIM↑", "ssim", 3), (f"{LPIPS_NAME}↓", "lpips", 3))
_METRICS = [
    *(Metric(f"ROI {title}", f"roi_{name}", digits) for title, name, digits in _KINDS),
    Metric("ROI depth L1 [cm]↓", "roi_depth_l1_m", 2, 100.0),
    Metric("ROI covered [%]↑", "roi_covered", 1, 100.0),
    *(Metric(f"full {title}", f"full_{name}", digits) for title, name, digits in _KINDS),
]
ROI_PSNR, FULL_PSNR = _METRICS[0], _METRICS[5]


class StudyResults:
    """Results of a study, indexed by scene, variant and budget."""

    def __init__(self, finished: Sequence[FinishedTrial]) -> None:
        self._results: dict[tuple[str, str, TrialBudget], list[TrialResult]] = {}
        for one in finished:
            key = one.trial.plan.name, one.trial.variant.label, one.trial.budget
            self._results.setdefault(key, []).append(one.result)
        self._finished = list(finished)
        self.tasks = {one.trial.plan.name: one.trial.plan.task for one in finished}
        self.scenes, self.variants, self.budgets = (
            list(dict.fromkeys(part)) for part in zip(*self._results, strict=True)
        )

    def values(self, scene: str, variant: str, metric: Metric, budget: TrialBudget) -> list[float]:
        """Return the metric of each seed that has it."""
        values = (metric.value(result) for result in self._results[scene, variant, budget])
        return [value for value in values if value is not None]

    def mean(self, scenes: Sequence[str], variant: str, metric: Metric, budget: TrialBudget) -> float | None:
        """Return the mean over these scenes; None if one of them lacks the metric."""
        values = [self.values(scene, variant, metric, budget) for scene in scenes]
        return fmean(map(fmean, values)) if all(values) else None

    def margin(self, scene: str, metric: Metric, budget: TrialBudget) -> float | None:
        """Return the first variant's mean minus the best other's; None without a second variant or the metric."""
        first, *others = (self.values(scene, variant, metric, budget) for variant in self.variants)
        return fmean(first) - max(map(fmean, others)) if first and others and all(others) else None

    def shown(self, scene: str) -> str:
        """Return the region's visibility in the held-out views, such as "0.7% in 4 of 5 views"."""
        result = self._results[scene, self.variants[0], self.budgets[0]][0]
        return f"{result.roi_share:.1%} in {result.scores.n_roi_views} of {result.scores.n_views} views"

    def costs(self, variant: str, budget: TrialBudget) -> list[str]:
        """Return the mean iterations and milliseconds a frame, Gaussians and kB in messages."""
        costs = [result.cost for scene in self.scenes for result in self._results[scene, variant, budget]]
        columns = zip(
            *((c.iterations_mean, c.ms_per_frame, c.gaussians, c.map_bytes / 1e3) for c in costs), strict=True
        )
        return [f"{fmean(column):.{digits}f}" for column, digits in zip(columns, (1, 0, 0, 0), strict=True)]

    def trials_as_json(self) -> list[Mapping[str, object]]:
        """Return all trials as JSON values."""
        return [_trial_as_json(one) for one in self._finished]


def _trial_as_json(each: FinishedTrial) -> Mapping[str, object]:
    trial = each.trial
    names = {"scene": trial.plan.name, "task": trial.plan.task, "variant": trial.variant.label, "seed": trial.seed}
    return {**names, "budget": asdict(trial.budget), **asdict(each.result)}


def quality_table(results: StudyResults) -> str:
    """Return the comparison of policies at each budget: means over all scenes, and ROI PSNR of each scene."""
    blocks = []
    for budget in results.budgets:
        blocks += [
            f"## Equal {budget.equal} ({budget}), at most {budget.max_gaussians} Gaussians",
            _means(results, budget),
            "ROI PSNR in dB, of fitted views where poses may be wrong, and margins over the best other policy:",
            _by_scene(results, budget),
        ]
    return "\n\n".join(blocks) + "\n"


def ablation_table(results: StudyResults) -> str:
    """Return one row per component: ROI and full PSNR at every budget, per scene and on average."""
    columns = [(metric, budget) for budget in results.budgets for metric in (ROI_PSNR, FULL_PSNR)]
    blocks = []
    for name, scenes in {**{scene: [scene] for scene in results.scenes}, "Mean": results.scenes}.items():
        task = f": {results.tasks[name]} (ROI {results.shown(name)})" if name in results.tasks else ""
        rows = [["components", *(f"{metric.title}, equal {budget.equal}" for metric, budget in columns)]]
        rows += [
            [variant, *(_number(results.mean(scenes, variant, *column), column[0]) for column in columns)]
            for variant in results.variants
        ]
        blocks += [f"## {name}{task}", markdown(rows)]
    return "\n\n".join(blocks) + "\n"


def _means(results: StudyResults, budget: TrialBudget) -> str:
    costs = ("iterations a frame", "ms a frame", "Gaussians", "kB in messages")
    rows = [["policy", *(metric.title for metric in _METRICS), *costs]]
    for variant in results.variants:
        means = (results.mean(results.scenes, variant, metric, budget) for metric in _METRICS)
        cells = [_number(mean, metric) for mean, metric in zip(means, _METRICS, strict=True)]
        rows.append([variant, *cells, *results.costs(variant, budget)])
    return markdown(rows)


def _by_scene(results: StudyResults, budget: TrialBudget) -> str:
    rows = [["scene", "task", "ROI", *results.variants, f"margin, {ROI_PSNR.title}", f"margin, {FULL_PSNR.title}"]]
    for scene in results.scenes:
        cells = [_with_spread(results.values(scene, variant, ROI_PSNR, budget)) for variant in results.variants]
        margins = [results.margin(scene, metric, budget) for metric in (ROI_PSNR, FULL_PSNR)]
        signed = ["" if margin is None else f"{margin:+.2f}" for margin in margins]
        rows.append([scene, results.tasks[scene], results.shown(scene), *cells, *signed])
    known = [margin for scene in results.scenes if (margin := results.margin(scene, ROI_PSNR, budget)) is not None]
    if not known:
        return markdown(rows)
    ahead = f"{sum(margin > 0 for margin in known)} of {len(known)}, by {fmean(known):+.2f} dB in the mean"
    return f"{markdown(rows)}\n\n`{results.variants[0]}` exceeds the best other policy in {ahead}."


def _with_spread(values: Sequence[float]) -> str:
    return f"{fmean(values):.2f} ± {pstdev(values):.2f}" if values else "–"


def _number(value: float | None, metric: Metric) -> str:
    return "–" if value is None else f"{value:.{metric.digits}f}"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a table whose first row is the header."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)
