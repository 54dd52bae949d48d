"""Run a quality study on the terminal: checks before the start, progress, and result files."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.mission.build import chosen_detector
from gausslite.mission.results import write_json
from gausslite_bench.quality.equal_time import first_visible_scene, load_rate, measure_rate, rate_trials
from gausslite_bench.quality.scenes import UnseenRegionError
from gausslite_bench.quality.study import FinishedTrial, Origin, Study, expected_origins, run_study
from gausslite_bench.quality.tables import StudyResults
from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_evaluation.lpips import load_lpips

RATE_FILE = "rate.json"


def run_with_progress(
    study: Study, folder: Path, lpips_weights: Path | None, reuse_other_code: bool = False
) -> StudyResults:
    """Return the results of the study; finished trials are cached in the folder. Raises GaussLiteError."""
    # invalid names, numbers and files must fail before hours of work
    for plan in study.plans:
        for trial in study.trials(plan):
            _ = trial.mission
    chosen_detector(study.conditions.perception.detector)
    lpips = None if lpips_weights is None else load_lpips(lpips_weights, study.conditions.threads)
    cache = TrialCache(folder)
    study = _with_measured_rate(study, folder / RATE_FILE)
    _warn_about_other_code(expected_origins(study, cache, lpips is not None, reuse_other_code))
    with _StudyBar(study.count) as bar:
        finished = run_study(study, cache, lpips, bar, reuse_other_code)
    origins = Counter(trial.origin for trial in finished)
    print_above_bar(f"trials: {', '.join(f'{count} {origin}' for origin, count in origins.items())}")
    return StudyResults(finished)


def write_results(folder: Path, name: str, table: str, results: StudyResults) -> None:
    """Write NAME.md and NAME.json to the folder and print the table. Raises StorageError."""
    command = shlex.join(["gausslite", *sys.argv[1:]])
    text = f"# bench {name}\n\n`{command}`\n\n{table}"
    write_atomic(folder / f"{name}.md", text.encode())
    write_json(folder / f"{name}.json", {"command": command, **results.as_json()})
    print(table)
    print(f"→ {folder / f'{name}.md'}")


def _with_measured_rate(study: Study, path: Path) -> Study:
    """Return the study with a rate in every budget; measure the rate if it is neither given nor stored."""
    trials = rate_trials(study)
    if not trials:
        return study
    rate_hz = load_rate(path, trials)
    if rate_hz is None:
        trial, scene = first_visible_scene(trials)
        with progress_bar(len(scene.training), f"uniform mapping of {trial.plan.name}", "frame") as bar:
            rate_hz = measure_rate(path, trial, scene, partial(_advance, bar))
    budget = f"{1e3 / rate_hz:.3g} ms per frame, the time of uniform mapping with {trials[0].budget}"
    print_above_bar(f"equal time: {budget} ({path})")
    return study.with_rate(rate_hz)


def _advance(bar: tqdm[Any], gaussians: int) -> None:
    del gaussians
    bar.update(1)


def _warn_about_other_code(expected: Counter[Origin]) -> None:
    """Warn before the study starts: the user may stop and reuse results that a code change does not affect."""
    if recomputed := expected[Origin.RECOMPUTED]:
        line = f"{recomputed} cached trials from other code will be computed again; --reuse-other-code keeps them"
        print_above_bar(line)
    if reused := expected[Origin.CACHED_OTHER_CODE]:
        print_above_bar(f"{reused} cached trials from other code are reused: scores may not be comparable")


class _StudyBar:
    """StudyObserver with a progress bar over trials and one line per finished trial."""

    def __init__(self, count: int) -> None:
        self._bar = progress_bar(count, "trials", "trial")
        self._on_terminal = sys.stderr.isatty()
        self._frames = 0

    def __enter__(self) -> _StudyBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def on_frame(self, gaussians: int) -> None:
        """Show the number of frames and Gaussians."""
        self._frames += 1
        text = f"frame {self._frames}, {gaussians / 1e3:.1f}k Gaussians"
        self._bar.set_postfix_str(text, refresh=self._on_terminal)

    def on_skipped(self, trials: int, reason: UnseenRegionError) -> None:
        """Print the skipped scene and the reason."""
        print_above_bar(f"skipped: {reason}")
        self._bar.update(trials)

    def on_finished(self, trial: FinishedTrial) -> None:
        """Print the trial's scores."""
        self._frames = 0
        settings, scores = trial.trial, trial.result.scores
        roi = "no view shows the region" if scores.roi_psnr is None else f"ROI {scores.roi_psnr:.2f} dB"
        origin = "" if trial.origin is Origin.COMPUTED else f" ({trial.origin})"
        print_above_bar(
            f"{settings.plan.name} {settings.variant.label} equal {settings.budget.equal} seed {settings.seed}: "
            f"{roi}, full {scores.full_psnr:.2f} dB{origin}"
        )
        self._bar.update()
