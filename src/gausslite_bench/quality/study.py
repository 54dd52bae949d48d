"""Many trials, one after the other; what is finished is kept in a folder and never run twice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.errors import GaussLiteError, StorageError
from gausslite.evaluation.compare import PerceptualDistance
from gausslite.evaluation.pictures import comparison_sheet, write_png
from gausslite.evaluation.views import largest_roi_views
from gausslite.mission.results import prepare_folder, write_json
from gausslite_bench.quality.code_hash import current_code_hash
from gausslite_bench.quality.scenes import Scene, ScenePlan, UnseenRegionError
from gausslite_bench.quality.trials import (
    PICTURES,
    Conditions,
    Pictures,
    Trial,
    TrialBudget,
    TrialMap,
    TrialResult,
    Variant,
    build_map,
    evaluate_map,
)


class Origin(StrEnum):
    """How a study came by a trial's result."""

    COMPUTED = "made"
    RECOMPUTED = "made again, as other code had made the kept one"
    CACHED = "kept"
    CACHED_OTHER_CODE = "kept, made by other code"


@runtime_checkable
class StudyObserver(Protocol):
    """Is told how a study goes on."""

    def frame(self, gaussians: int) -> None:
        """A frame was mapped."""
        ...

    def finished(self, done: FinishedTrial) -> None:
        """A trial has its result."""
        ...

    def left_out(self, trials: int, why: UnseenRegionError) -> None:
        """A scene's trials are not made, as there is nothing to judge them by."""
        ...


@dataclass(frozen=True, slots=True)
class Study:
    """Every variant on every scene, from every seed, within each budget."""

    plans: Sequence[ScenePlan]
    variants: Sequence[Variant]
    budgets: Sequence[TrialBudget]
    seeds: Sequence[int]
    conditions: Conditions

    def trials(self, plan: ScenePlan) -> list[Trial]:
        """Those on one scene, each seed's variants beside each other."""
        return [
            Trial(plan, variant, budget, seed, self.conditions)
            for budget in self.budgets
            for seed in self.seeds
            for variant in self.variants
        ]

    def paced(self, rate_hz: float) -> Study:
        """The same, with this rate where one was still to be measured."""
        budgets = [replace(each, rate_hz=rate_hz) if each.awaits_rate else each for each in self.budgets]
        return replace(self, budgets=budgets)

    @property
    def count(self) -> int:
        """Trials in all."""
        return len(self.plans) * len(self.budgets) * len(self.seeds) * len(self.variants)


@dataclass(frozen=True, slots=True, eq=False)
class FinishedTrial:
    """A trial, what it gave, and whether that was known before."""

    trial: Trial
    result: TrialResult
    origin: Origin

    @property
    def of_other_code(self) -> bool:
        """Whether its figures are of other code than this program's."""
        return self.origin is Origin.CACHED_OTHER_CODE


@dataclass(frozen=True, slots=True)
class CachedTrial:
    """A result from an archive, and the hash_files of the code that gave it."""

    result: TrialResult
    code: str


class TrialCache:
    """A folder of finished trials: in trials/ a record each and what its map looked like, in sheets/ comparisons.

    code is the hash_files of what runs now, taken before any trial does: the files may change while one runs.
    """

    def __init__(self, folder: Path) -> None:
        """Raises StorageError where the folder cannot be written."""
        self.code = current_code_hash()
        self._trials, self._sheets = folder / "trials", folder / "sheets"
        for part in (self._trials, self._sheets):
            prepare_folder(part)

    def recall(self, trial: Trial, with_lpips: bool) -> CachedTrial | None:
        """The result of a finished trial, whatever code gave it; None when there is none, one whose pictures are gone,
        or one without the LPIPS that is wanted now.
        """
        try:
            record = json.loads(self._record(trial).read_text())
            kept = CachedTrial(TrialResult.from_json(record["result"]), str(record["code"]))
            pictures = [self._picture(trial, position) for position in record["pictures"]]
        except (OSError, ValueError, KeyError, TypeError, GaussLiteError):
            return None
        if with_lpips and kept.result.scores.full_lpips is None:
            return None
        return kept if all(picture.is_file() for picture in pictures) else None

    def keep(self, trial: Trial, result: TrialResult, pictures: Pictures) -> None:
        """Write a trial that this program finished, its record last. Raises StorageError."""
        for position, picture in pictures.items():
            write_png(self._picture(trial, position), picture)
        record = {
            "settings": _summary(trial),
            "code": self.code,
            "pictures": sorted(pictures),
            "result": result.as_json(),
        }
        write_json(self._record(trial), record)

    def draw_sheets(self, trials: Sequence[Trial], scene: Scene) -> None:
        """Write ground truth and these trials' maps side by side, with crops of the region. Raises StorageError."""
        for position in sorted(largest_roi_views(scene.held_out, PICTURES)):
            drawings = {trial.variant.label: self._drawing(trial, position) for trial in trials}
            sheet = comparison_sheet(scene.held_out[position], drawings)
            write_png(self._sheets / f"{trials[0].plan.name}-view-{position:03d}.png", sheet)

    def _drawing(self, trial: Trial, position: int) -> Float32[ndarray, "h w 3"]:
        import cv2

        path = self._picture(trial, position)
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise StorageError(f"{path}: expected a kept picture; remove it, and its trial is made again")
        return np.ascontiguousarray(image[..., ::-1]).astype(np.float32) / np.float32(255.0)

    def _record(self, trial: Trial) -> Path:
        return self._trials / f"{trial.key}.json"

    def _picture(self, trial: Trial, position: int) -> Path:
        return self._trials / f"{trial.key}-view-{position:03d}.png"


class _MapCache:
    """Maps that know no task, kept for the other tasks in the same place: what is judged again is not made again."""

    def __init__(self) -> None:
        self._place: Mapping[str, object] = {}
        self._maps: dict[str, TrialMap] = {}

    def enter(self, plan: ScenePlan) -> None:
        """Forget the maps of another place."""
        if plan.place() != self._place:
            self._place, self._maps = plan.place(), {}

    def take(self, trial: Trial, scene: Scene, watcher: StudyObserver) -> TrialMap:
        """The trial's map, made unless it is here. Raises GaussLiteError."""
        made = self._maps.get(trial.map_key)
        if made is None:
            made = build_map(trial, scene, watcher.frame)
        if not trial.follows_task:
            self._maps[trial.map_key] = made
        return made


def run_study(
    study: Study,
    archive: TrialCache,
    perceptual: PerceptualDistance | None,
    watcher: StudyObserver,
    reuse_other_code: bool = False,
) -> list[FinishedTrial]:
    """Run what is not finished yet. A scene's frames are made only if one of its trials needs them.

    What other code finished is made again, unless it may be reused. A scene whose region is in no held-out view is left
    out. Raises UnseenRegionError where that leaves nothing.
    """
    finished: list[FinishedTrial] = []
    shelf = _MapCache()
    unseen: UnseenRegionError | None = None
    for plan in study.plans:
        shelf.enter(plan)
        trials = study.trials(plan)
        looked_up = [_look_up(trial, archive, perceptual is not None, reuse_other_code) for trial in trials]
        scene: Scene | None = None
        if any(kept is None for kept, _ in looked_up):
            try:
                scene = plan.load(study.conditions.size)
            except UnseenRegionError as error:
                unseen = error
                watcher.left_out(len(trials), error)
                continue
        for trial, (kept, origin) in zip(trials, looked_up, strict=True):
            if kept is not None:
                result = kept.result
            else:
                assert scene is not None
                made = shelf.take(trial, scene, watcher)
                result, pictures = evaluate_map(made, trial, scene, perceptual)
                archive.keep(trial, result, pictures)
            finished.append(FinishedTrial(trial, result, origin))
            watcher.finished(finished[-1])
        if scene is not None:
            archive.draw_sheets(trials[: len(study.variants)], scene)
    if unseen is not None and not finished:
        raise unseen
    return finished


def expected_origins(study: Study, archive: TrialCache, with_lpips: bool, reuse_other_code: bool) -> Counter[Origin]:
    """How many trials run_study would make and how many it would take from the archive."""
    trials = (trial for plan in study.plans for trial in study.trials(plan))
    return Counter(_look_up(trial, archive, with_lpips, reuse_other_code)[1] for trial in trials)


def _look_up(
    trial: Trial, archive: TrialCache, with_lpips: bool, reuse_other_code: bool
) -> tuple[CachedTrial | None, Origin]:
    kept = archive.recall(trial, with_lpips)
    if kept is None:
        return None, Origin.COMPUTED
    if kept.code == archive.code:
        return kept, Origin.CACHED
    return (kept, Origin.CACHED_OTHER_CODE) if reuse_other_code else (None, Origin.RECOMPUTED)


def _summary(trial: Trial) -> Mapping[str, object]:
    return {"scene": dict(trial.plan.settings()), "mission": str(trial.mission), "conditions": str(trial.conditions)}
