"""The trial cache: results with their images, and the hash of the code that computed them."""

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
from gausslite_bench.quality.trial_cache import CachedTrial, TrialCache
from gausslite_bench.quality.trials import Trial, TrialBudget, TrialResult


def cached_result(cache: TrialCache, trial: Trial, with_lpips: bool = False) -> TrialResult | None:
    cached = cache.load_trial(trial, with_lpips)
    return None if cached is None else cached.result


def test_a_stored_trial_is_loaded_unless_lpips_is_requested_and_missing(tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    assert cached_result(cache, one.trial) is None
    cache.store_trial(one.trial, one.result, {})
    assert cached_result(cache, one.trial) == one.result
    assert cached_result(cache, one.trial, with_lpips=True) is None
    assert cached_result(cache, replace(one.trial, seed=1)) is None


def test_a_trial_with_a_missing_image_is_not_loaded(tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    cache.store_trial(one.trial, one.result, {position: np.zeros((72, 96, 3), np.uint8) for position in (0, 2)})
    assert cached_result(cache, one.trial) == one.result
    next((tmp_path / "trials").glob("*-view-002.png")).unlink()
    assert cached_result(cache, one.trial) is None


@pytest.mark.parametrize("record", ["{}", "[]", "1", "", '{"result": {}, "pictures": []}'])
def test_an_invalid_record_is_not_loaded(record: str, tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    cache.store_trial(one.trial, one.result, {})
    next((tmp_path / "trials").glob("*.json")).write_text(record)
    assert cached_result(cache, one.trial) is None


def other_code(folder: Path) -> Path:
    """Change the code hash of one stored trial; return its path."""
    path = min((folder / "trials").glob("*.json"))
    path.write_text(json.dumps({**json.loads(path.read_text()), "code": "other-hash"}))
    return path


def test_a_record_holds_the_hash_of_its_code(tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    cache.store_trial(one.trial, one.result, {})
    assert cache.load_trial(one.trial, with_lpips=False) == CachedTrial(one.result, current_code_hash())
    other_code(tmp_path)
    assert cache.load_trial(one.trial, with_lpips=False) == CachedTrial(one.result, "other-hash")


def test_the_hash_changes_with_every_byte_and_the_order(tmp_path: Path) -> None:
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


def test_all_files_that_a_trial_imports_are_hashed() -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    program = (
        "import sys\n"
        "from gausslite_bench.quality.home_tasks import HOME_TASKS\n"
        "from gausslite_bench.quality.home_scenes import HomeScenePlan\n"
        "from gausslite_bench.quality.scenes import PosePolicy\n"
        "from gausslite_bench.quality.trials import TrialBudget, Conditions, Trial, Variant, evaluate_map, build_map\n"
        "plan = HomeScenePlan(HOME_TASKS[0], frames=2, views=2, pose_policy=PosePolicy(fit_views=True))\n"
        "trial = Trial(plan, Variant('task', 'task'), TrialBudget(500, iterations=2), 0, Conditions((64, 48)))\n"
        "scene = plan.load((64, 48))\n"
        "evaluate_map(build_map(trial, scene, lambda gaussians: None), trial, scene, None)\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('gausslite')), sep='\\n')\n"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, text=True).stdout.split()
    assert len(loaded) > 50
    assert set(loaded) <= {str(path) for path in trial_source_files()}


def test_trials_from_other_code_are_computed_again_unless_reuse_is_requested(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "2", "--views", "2"]
    budget = ["--max-gaussians", "500", "--iterations", "1", "--threads", "1"]
    command = ["bench", "quality", "--out", str(tmp_path), "--policies", "task,uniform", *options, *budget]
    assert main(command) == 0
    assert "trials: 2 computed\n" in capsys.readouterr().err
    record = other_code(tmp_path)

    assert main([*command, "--reuse-other-code"]) == 0
    reused = capsys.readouterr()
    assert "1 cached trials from other code are reused: scores may not be comparable" in reused.err
    assert "trials: 1 cached, from other code, 1 cached\n" in reused.err
    assert "**1 of these 2 trials are from other code: their scores may not be comparable.**" in reused.out
    [scene] = json.loads((tmp_path / "quality.json").read_text())["scenes"]
    assert sorted(trial["other_code"] for each in scene["results"] for trial in each["trials"]) == [False, True]
    assert json.loads(record.read_text())["code"] == "other-hash"

    assert main(command) == 0
    again = capsys.readouterr()
    assert "1 cached trials from other code will be computed again; --reuse-other-code keeps them" in again.err
    assert "trials: 1 computed again, as the cached result is from other code, 1 cached\n" in again.err
    assert "other code" not in again.out
    assert json.loads(record.read_text())["code"] == current_code_hash()
