"""Trials that a folder keeps: recalled whole, with their pictures, and for the code that made them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quality_results import TASK, finished

from gausslite.cli.main import main
from gausslite_bench.quality.code_hash import current_code_hash, hash_files, trial_source_files
from gausslite_bench.quality.study import CachedTrial, TrialCache
from gausslite_bench.quality.trials import Trial, TrialBudget, TrialResult


def recalled(archive: TrialCache, trial: Trial, with_lpips: bool = False) -> TrialResult | None:
    kept = archive.recall(trial, with_lpips)
    return None if kept is None else kept.result


def test_what_is_finished_is_recalled_unless_lpips_is_wanted(tmp_path: Path) -> None:
    archive, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    assert recalled(archive, one.trial) is None
    archive.keep(one.trial, one.result, {})
    assert recalled(archive, one.trial) == one.result
    assert recalled(archive, one.trial, with_lpips=True) is None
    assert recalled(archive, replace(one.trial, seed=1)) is None


def test_a_trial_whose_picture_is_gone_is_not_kept(tmp_path: Path) -> None:
    archive, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    archive.keep(one.trial, one.result, {position: np.zeros((72, 96, 3), np.uint8) for position in (0, 2)})
    assert recalled(archive, one.trial) == one.result
    next((tmp_path / "trials").glob("*-view-002.png")).unlink()
    assert recalled(archive, one.trial) is None


@pytest.mark.parametrize("record", ["{}", "[]", "1", "", '{"result": {}, "pictures": []}'])
def test_what_is_no_record_is_not_recalled(record: str, tmp_path: Path) -> None:
    archive, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    archive.keep(one.trial, one.result, {})
    next((tmp_path / "trials").glob("*.json")).write_text(record)
    assert recalled(archive, one.trial) is None


def other_code(folder: Path) -> Path:
    """One of the folder's trials, as if other code had made it."""
    path = min((folder / "trials").glob("*.json"))
    path.write_text(json.dumps({**json.loads(path.read_text()), "code": "of yesterday"}))
    return path


def test_a_record_tells_which_code_made_it(tmp_path: Path) -> None:
    archive, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    archive.keep(one.trial, one.result, {})
    assert archive.recall(one.trial, with_lpips=False) == CachedTrial(one.result, current_code_hash())
    other_code(tmp_path)
    assert archive.recall(one.trial, with_lpips=False) == CachedTrial(one.result, "of yesterday")


def test_code_that_changes_while_a_trial_runs_is_not_told_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, one, begun = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget()), current_code_hash()
    monkeypatch.setattr("gausslite_bench.quality.study.current_code_hash", lambda: "of later")
    archive.keep(one.trial, one.result, {})
    assert archive.recall(one.trial, with_lpips=False) == CachedTrial(one.result, begun)


def test_a_fingerprint_changes_with_every_byte_and_name(tmp_path: Path) -> None:
    files = [tmp_path / "a.py", tmp_path / "b.py"]
    seen = set()
    for texts in (("", ""), ("x", ""), ("", "x"), ("x", "x")):
        for path, text in zip(files, texts, strict=True):
            path.write_text(text)
        seen.add(hash_files(files))
    seen.add(hash_files(files[::-1]))
    seen.add(hash_files(files[:1]))
    assert len(seen) == 6
    assert hash_files(files) in seen


def test_all_that_a_trial_runs_is_in_its_fingerprint() -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    program = (
        "import sys\n"
        "from gausslite_bench.quality.home_tasks import HOME_TASKS\n"
        "from gausslite_bench.quality.scenes import HomeScenePlan, PosePolicy\n"
        "from gausslite_bench.quality.trials import TrialBudget, Conditions, Trial, Variant, evaluate_map, build_map\n"
        "plan = HomeScenePlan(HOME_TASKS[0], frames=2, views=2, trust=PosePolicy(fit_views=True))\n"
        "trial = Trial(plan, Variant('task', 'task'), TrialBudget(500, iterations=2), 0, Conditions((64, 48)))\n"
        "scene = plan.load((64, 48))\n"
        "evaluate_map(build_map(trial, scene, lambda gaussians: None), trial, scene, None)\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('gausslite')), sep='\\n')\n"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, text=True).stdout.split()
    assert len(loaded) > 50
    assert set(loaded) <= {str(path) for path in trial_source_files()}


def test_finished_trials_of_other_code_are_made_again_unless_they_may_be_reused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    asked = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "2", "--views", "2"]
    budget = ["--max-gaussians", "500", "--iterations", "1", "--threads", "1"]
    command = ["bench", "quality", "--out", str(tmp_path), "--policies", "task,uniform", *asked, *budget]
    assert main(command) == 0
    assert "trials: 2 made\n" in capsys.readouterr().err
    record = other_code(tmp_path)

    assert main([*command, "--reuse-other-code"]) == 0
    reused = capsys.readouterr()
    assert "1 finished trials of other code are taken as they are: figures may not compare" in reused.err
    assert "trials: 1 kept, made by other code, 1 kept\n" in reused.err
    assert "**1 of these 2 trials were made by other code: their figures may not compare.**" in reused.out
    [scene] = json.loads((tmp_path / "quality.json").read_text())["scenes"]
    assert sorted(trial["other_code"] for each in scene["results"] for trial in each["trials"]) == [False, True]
    assert json.loads(record.read_text())["code"] == "of yesterday"

    assert main(command) == 0
    again = capsys.readouterr()
    assert "1 finished trials of other code will be made again; --reuse-other-code takes them" in again.err
    assert "trials: 1 made again, as other code had made the kept one, 1 kept\n" in again.err
    assert "other code" not in again.out
    assert json.loads(record.read_text())["code"] == current_code_hash()
