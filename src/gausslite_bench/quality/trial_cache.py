"""Folder of finished trials, so that a study can be interrupted and continued."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.codec.state_file import write_png
from gausslite.domain.errors import GaussLiteError, StorageError
from gausslite.mission.results import prepare_folder, write_json
from gausslite_bench.quality.code_hash import current_code_hash
from gausslite_bench.quality.scenes import Scene
from gausslite_bench.quality.trials import SHEET_VIEWS, Trial, TrialResult, ViewImages
from gausslite_evaluation.pictures import comparison_sheet
from gausslite_evaluation.views import largest_roi_views


@dataclass(frozen=True, slots=True)
class CachedTrial:
    """A result from the cache, and the hash of the code that computed it."""

    result: TrialResult
    code: str


class TrialCache:
    """A folder with one JSON record and the rendered views per trial (trials/), and comparison sheets (sheets/).

    code: hash of the running code, computed before the first trial, since the files may change during a study.
    """

    def __init__(self, folder: Path) -> None:
        """Create the folder. Raises StorageError if it cannot be written."""
        self.code = current_code_hash()
        self._trials, self._sheets = folder / "trials", folder / "sheets"
        for part in (self._trials, self._sheets):
            prepare_folder(part)

    def load_trial(self, trial: Trial, with_lpips: bool) -> CachedTrial | None:
        """Return the stored result, whatever code computed it.

        None if there is no complete record, if an image is missing, or if it lacks the requested LPIPS.
        """
        try:
            record = json.loads(self._record_path(trial).read_text())
            cached = CachedTrial(TrialResult.from_json(record["result"]), str(record["code"]))
            images = [self._image_path(trial, position) for position in record["pictures"]]
        except (OSError, ValueError, KeyError, TypeError, GaussLiteError):
            return None
        if with_lpips and cached.result.scores.full_lpips is None:
            return None
        return cached if all(image.is_file() for image in images) else None

    def store_trial(self, trial: Trial, result: TrialResult, images: ViewImages) -> None:
        """Write a trial computed by the running code; the record is written last. Raises StorageError."""
        for position, image in images.items():
            write_png(self._image_path(trial, position), image)
        record = {
            "settings": _settings(trial),
            "code": self.code,
            "pictures": sorted(images),
            "result": result.as_json(),
        }
        write_json(self._record_path(trial), record)

    def write_sheets(self, trials: Sequence[Trial], scene: Scene) -> None:
        """Write comparison sheets of these trials' maps on one scene. Raises StorageError."""
        for position in sorted(largest_roi_views(scene.held_out, SHEET_VIEWS)):
            renderings = {trial.variant.label: self._load_image(trial, position) for trial in trials}
            sheet = comparison_sheet(scene.held_out[position], renderings)
            write_png(self._sheets / f"{trials[0].plan.name}-view-{position:03d}.png", sheet)

    def _load_image(self, trial: Trial, position: int) -> Float32[ndarray, "h w 3"]:
        import cv2

        path = self._image_path(trial, position)
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise StorageError(f"{path}: expected an image; remove the file to compute its trial again")
        return np.ascontiguousarray(image[..., ::-1]).astype(np.float32) / np.float32(255.0)

    def _record_path(self, trial: Trial) -> Path:
        return self._trials / f"{trial.key}.json"

    def _image_path(self, trial: Trial, position: int) -> Path:
        return self._trials / f"{trial.key}-view-{position:03d}.png"


def _settings(trial: Trial) -> Mapping[str, object]:
    return {"scene": dict(trial.plan.settings()), "mission": str(trial.mission), "conditions": str(trial.conditions)}
