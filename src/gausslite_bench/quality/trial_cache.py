"""Folder of finished trials, so that a study can be interrupted and continued; results of other code do not count."""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

from gausslite.mission.results import prepare_folder, write_json
from gausslite_bench.quality.trials import Trial, TrialResult

_SOURCES = Path(__file__).resolve().parents[2]
"""The folder of the packages that a trial runs."""


class TrialCache:
    """A folder with one JSON record for each trial and each state of the code."""

    def __init__(self, folder: Path) -> None:
        """Create the folder. Raises StorageError if it cannot be written."""
        self._folder = folder / "trials"
        # before the first trial, since the files may change during a study
        self._code = current_code_hash()
        prepare_folder(self._folder)

    def load(self, trial: Trial, with_lpips: bool) -> TrialResult | None:
        """Return the stored result; None without a complete record, or if it lacks the requested LPIPS."""
        try:
            result = TrialResult.from_json(json.loads(self._path(trial).read_text())["result"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return None if with_lpips and result.scores.full_lpips is None else result

    def store(self, trial: Trial, result: TrialResult) -> None:
        """Write a trial that the running code computed. Raises StorageError."""
        settings = {"scene": dict(trial.plan.settings()), "mission": str(trial.mission)}
        record = {**settings, "conditions": str(trial.conditions), "result": asdict(result)}
        write_json(self._path(trial), record)

    def _path(self, trial: Trial) -> Path:
        return self._folder / f"{trial.key}-{self._code}.json"


@functools.cache
def current_code_hash() -> str:
    """Return the hash of the sources and kernels on disk at the first call, without other libraries.

    It is cached, since a process keeps running the code it loaded.
    """
    # an editable installation stores the kernels apart from the sources
    kernels = [find_spec(name) for name in ("gausslite.render._kernels", "gausslite.codec._unpack")]
    origins = (Path(spec.origin) for spec in kernels if spec is not None and spec.origin is not None)
    digest = hashlib.sha256()
    for path in (*sorted(_SOURCES.glob("gausslite*/**/*.py")), *origins):
        digest.update(f"{path.name} ".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:12]
