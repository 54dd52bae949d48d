"""Tables of a study: means and spreads over seeds, as JSON and as Markdown in the shape of the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import fmean, pstdev

from gausslite_bench.quality.study import FinishedTrial
from gausslite_bench.quality.trials import TrialBudget


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of MapScores, raw or fitted; factor brings it to the table's unit."""

    title: str
    field: str
    digits: int
    factor: float = 1.0
    fitted: bool = False

    @property
    def name(self) -> str:
        """For JSON."""
        return f"fitted_{self.field}" if self.fitted else self.field


ROI_METRICS = (
    Metric("PSNR↑", "roi_psnr", 2),
    Metric("SSIM↑", "roi_ssim", 3),
    Metric("LPIPS↓", "roi_lpips", 3),
    Metric("depth L1 [cm]↓", "roi_depth_l1_m", 2, 100.0),
    Metric("covered [%]↑", "roi_covered", 1, 100.0),
)
FULL_METRICS = (
    Metric("PSNR↑", "full_psnr", 2),
    Metric("SSIM↑", "full_ssim", 3),
    Metric("LPIPS↓", "full_lpips", 3),
    Metric("depth L1 [cm]↓", "full_depth_l1_m", 2, 100.0),
)
FITTED_METRICS = (
    Metric("PSNR, views fitted↑", "roi_psnr", 2, fitted=True),
    Metric("PSNR, views fitted↑", "full_psnr", 2, fitted=True),
)
RAW_PSNR = (ROI_METRICS[0], FULL_METRICS[0])
_NOT_COMPUTED = "not computed"


@dataclass(frozen=True, slots=True)
class Figure:
    """Mean and spread (standard deviation) over the seeds."""

    mean: float
    spread: float

    def as_text(self, digits: int, factor: float = 1.0) -> str:
        """Such as "27.31 ± 0.08"."""
        return f"{factor * self.mean:.{digits}f} ± {factor * self.spread:.{digits}f}"


class Scoreboard:
    """Looks a study's results up by scene, variant and budget."""

    def __init__(self, finished: Sequence[FinishedTrial]) -> None:
        self._finished = list(finished)
        trials = [each.trial for each in finished]
        self.scenes = list(dict.fromkeys(trial.plan.name for trial in trials))
        self.variants = list(dict.fromkeys(trial.variant.label for trial in trials))
        self.budgets = list(dict.fromkeys(trial.budget for trial in trials))

    @property
    def has_fitted(self) -> bool:
        """Whether views were scored fitted too."""
        return any(each.result.fitted is not None for each in self._finished)

    @property
    def notes(self) -> list[str]:
        """What a reader must know first: that trials of other code are among them."""
        others, count = sum(each.of_other_code for each in self._finished), len(self._finished)
        text = f"**{others} of these {count} trials were made by other code: their figures may not compare.**"
        return [text] if others else []

    def figure(self, scene: str, variant: str, metric: Metric, budget: TrialBudget) -> Figure | None:
        """Over the seeds; None where no trial has it."""
        results = [each.result for each in self._of(scene, variant, budget)]
        scores = [result.fitted if metric.fitted else result.scores for result in results]
        values = [getattr(each, metric.field) for each in scores if each is not None]
        known = [value for value in values if value is not None]
        return Figure(fmean(known), pstdev(known)) if known else None

    def mean(self, scenes: Sequence[str], variant: str, metric: Metric, budget: TrialBudget) -> float | None:
        """Over these scenes; None where one of them does not have it."""
        figures = [self.figure(scene, variant, metric, budget) for scene in scenes]
        known = [figure.mean for figure in figures if figure is not None]
        return fmean(known) if known and len(known) == len(figures) else None

    def margin(self, scene: str, metric: Metric, budget: TrialBudget) -> float | None:
        """How far the first variant is before the best other; None with a single variant or without the figure."""
        ours, *others = (self.figure(scene, variant, metric, budget) for variant in self.variants)
        known = [other.mean for other in others if other is not None]
        return ours.mean - max(known) if ours is not None and known else None

    def margins(self, metric: Metric, budget: TrialBudget) -> list[float]:
        """Of the scenes that have the figure."""
        return [m for scene in self.scenes if (m := self.margin(scene, metric, budget)) is not None]

    def roi_share(self, scene: str) -> float:
        """Share of the held-out views' pixels in the region."""
        return next(each.result.roi_share for each in self._finished if each.trial.plan.name == scene)

    def shown(self, scene: str) -> str:
        """How much of the region there is to judge by, such as "0.7% in 4 of 5 views"."""
        scores = next(each.result.scores for each in self._finished if each.trial.plan.name == scene)
        return f"{self.roi_share(scene):.1%} in {scores.n_roi_views} of {scores.n_views} views"

    def task(self, scene: str) -> str:
        """What the robot was asked to do."""
        return next(each.trial.plan.task for each in self._finished if each.trial.plan.name == scene)

    def cost(self, variant: str, budget: TrialBudget) -> tuple[float, float]:
        """Mean iterations and milliseconds a frame, over all scenes and seeds."""
        results = [result for scene in self.scenes for result in (e.result for e in self._of(scene, variant, budget))]
        return fmean(r.iterations_mean for r in results), fmean(r.ms_per_frame for r in results)

    def as_json(self) -> dict[str, object]:
        """Every figure, and every trial behind it."""
        return {
            "budgets": [asdict(budget) for budget in self.budgets],
            "scenes": [self._scene_as_json(scene) for scene in self.scenes],
            "summary": [self._summary(budget) for budget in self.budgets],
        }

    def _of(self, scene: str, variant: str, budget: TrialBudget) -> list[FinishedTrial]:
        return [
            each
            for each in self._finished
            if (each.trial.plan.name, each.trial.variant.label, each.trial.budget) == (scene, variant, budget)
        ]

    def _scene_as_json(self, scene: str) -> dict[str, object]:
        metrics = (*ROI_METRICS, *FULL_METRICS, *FITTED_METRICS)
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
                            {"seed": each.trial.seed, "other_code": each.of_other_code, **each.result.as_json()}
                            for each in self._of(scene, variant, budget)
                        ],
                    }
                )
        return {"scene": scene, "task": self.task(scene), "roi_share": self.roi_share(scene), "results": results}

    def _summary(self, budget: TrialBudget) -> dict[str, object]:
        metrics = (*RAW_PSNR, ROI_METRICS[1], *FITTED_METRICS)
        known = {metric.name: self.margins(metric, budget) for metric in metrics}
        return {
            "equal": str(budget.equal),
            "ahead_in": sum(margin > 0 for margin in known["roi_psnr"]),
            "scenes": len(known["roi_psnr"]),
            "mean_margin": {name: fmean(listed) if listed else None for name, listed in known.items()},
        }


def quality_table(board: Scoreboard) -> str:
    """The comparison of policies: by place as in the paper's Replica table, then pair by pair, then the sum of it."""
    blocks = board.notes
    fitted = FITTED_METRICS if board.has_fitted else ()
    for budget in board.budgets:
        blocks += [
            f"## Equal {budget.equal} ({budget}), at most {budget.max_gaussians} Gaussians",
            "Inside the task's ground-truth mask (the mean over a place's tasks):",
            _by_place(board, (*ROI_METRICS, *fitted[:1]), budget),
            "Over the full image:",
            _by_place(board, (*FULL_METRICS, *fitted[1:]), budget),
            "Pair by pair, ROI PSNR in dB (mean ± spread over the seeds):",
            _by_scene(board, RAW_PSNR, budget),
        ]
        if fitted:
            blocks += ["The same with each view's pose and colours fitted:", _by_scene(board, FITTED_METRICS, budget)]
        blocks.append(_in_words(board, budget))
    return "\n\n".join(blocks) + "\n"


def ablation_table(board: Scoreboard) -> str:
    """One row a component, ROI and full PSNR at every budget, scene by scene and on average, fitted too where asked."""
    blocks = board.notes
    for scene in board.scenes:
        title = f"## {scene}: {board.task(scene)} (ROI {board.shown(scene)})"
        blocks += [title, _by_component(board, [scene])]
    if len(board.scenes) > 1:
        blocks += [f"## The mean over these {len(board.scenes)}", _by_component(board, board.scenes)]
    return "\n\n".join(blocks) + "\n"


def _by_component(board: Scoreboard, scenes: Sequence[str]) -> str:
    """With the spread over the seeds where it is a single scene, with fitted views where all scenes have them."""
    columns = [("ROI PSNR", ROI_METRICS[0]), ("full PSNR", FULL_METRICS[0])]
    if board.mean(scenes, board.variants[0], FITTED_METRICS[1], board.budgets[0]) is not None:
        columns += zip(("ROI PSNR, views fitted", "full PSNR, views fitted"), FITTED_METRICS, strict=True)
    shown = [(metric, budget) for budget in board.budgets for _, metric in columns]
    rows = [["components", *(f"{title}, equal {budget.equal}" for budget in board.budgets for title, _ in columns)]]
    for variant in board.variants:
        if len(scenes) == 1:
            cells = [_text(board.figure(scenes[0], variant, *each), each[0]) for each in shown]
        else:
            cells = [_number(board.mean(scenes, variant, *each), each[0]) for each in shown]
        rows.append([variant, *cells])
    return _markdown(rows)


def _by_place(board: Scoreboard, metrics: Sequence[Metric], budget: TrialBudget) -> str:
    places: dict[str, list[str]] = {}
    for scene in board.scenes:
        places.setdefault(scene.rsplit("-", 1)[0], []).append(scene)
    rows = [["policy", "metric", *places, "avg."]]
    for variant in board.variants:
        for metric in metrics:
            columns = [board.mean(scenes, variant, metric, budget) for scenes in (*places.values(), board.scenes)]
            cells = [_number(value, metric) for value in columns]
            rows.append([variant if metric is metrics[0] else "", metric.title, *cells])
    return _markdown(rows)


def _by_scene(board: Scoreboard, roi_and_full: tuple[Metric, Metric], budget: TrialBudget) -> str:
    roi, _ = roi_and_full
    rows = [["pair", "task", "ROI", *board.variants, "margin", "full margin"]]
    for scene in board.scenes:
        cells = [_text(board.figure(scene, variant, roi, budget), roi) for variant in board.variants]
        margins = [board.margin(scene, metric, budget) for metric in roi_and_full]
        signed = ["" if margin is None else f"{margin:+.2f}" for margin in margins]
        rows.append([scene, board.task(scene), board.shown(scene), *cells, *signed])
    return _markdown(rows)


def _in_words(board: Scoreboard, budget: TrialBudget) -> str:
    lines = []
    for (roi, full), how in ((RAW_PSNR, ""), (FITTED_METRICS, " with views fitted")):
        margins, beside = board.margins(roi, budget), board.margins(full, budget)
        if margins:
            ahead = f"{sum(m > 0 for m in margins)} of {len(margins)}"
            lines.append(
                f"`{board.variants[0]}` is ahead of the best other in {ahead}, by {fmean(margins):+.2f} dB inside the "
                f"mask on average and by {fmean(beside):+.2f} dB over the full image{how}."
            )
    for variant in board.variants:
        iterations, ms = board.cost(variant, budget)
        lines.append(f"`{variant}`: {iterations:.1f} iterations and {ms:.0f} ms a frame.")
    return "\n".join(lines)


def _text(figure: Figure | None, metric: Metric) -> str:
    return _NOT_COMPUTED if figure is None else figure.as_text(metric.digits, metric.factor)


def _number(value: float | None, metric: Metric) -> str:
    return _NOT_COMPUTED if value is None else f"{metric.factor * value:.{metric.digits}f}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)
