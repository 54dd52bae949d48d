"""The plug-in of `gausslite.evaluators`: PSNR of training views, the preview, and the trajectory's error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory
from gausslite.mission.evaluation import RenderFrame, TrainingFit, TrajectoryError
from gausslite_evaluation.compare import score_training_views
from gausslite_evaluation.metrics import trajectory_error
from gausslite_evaluation.pictures import render_preview


class RunEvaluator:
    """Implements `gausslite.mission.evaluation.Evaluator`."""

    def training_fit(self, render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]) -> TrainingFit:
        """Return the PSNR over five keyframes."""
        return score_training_views(render, keyframes)

    def preview(
        self, render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]
    ) -> UInt8[ndarray, "H W 3"]:
        """Return photographs and renderings of three keyframes."""
        return render_preview(render, keyframes)

    def trajectory_error(self, estimated: Trajectory, reference: Trajectory) -> TrajectoryError | None:
        """Return the ATE; None with fewer than 3 poses at times of the reference."""
        return trajectory_error(estimated, reference)


EVALUATOR: Final = RunEvaluator()
