"""The protocol of `gausslite.evaluators`: how well a finished run fits what its camera saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory
from gausslite.render.rasterizer import Rendering

RenderFrame = Callable[[Frame], Rendering]


@dataclass(frozen=True, slots=True)
class TrainingFit:
    """Mean PSNR in dB over views that a map was trained on; that of the region is None if no view shows it."""

    roi_psnr: float | None  # dB
    full_psnr: float
    n_views: int


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """ATE over the poses at common times (Sturm et al. 2012), aligned in SE(3), without scale."""

    rmse_m: float  # root of the mean squared distance
    max_m: float
    poses: int


@runtime_checkable
class Evaluator(Protocol):
    """A plug-in that `map` asks at its end; without one, `map` leaves out the figures and the picture.

    render: returns what the map shows in a frame's view. keyframes: frames in temporal order, at least one, each with
    the mask of the task's region.
    """

    def training_fit(self, render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]) -> TrainingFit:
        """Return how well the map fits keyframes that it was trained on."""

    def preview(
        self, render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]
    ) -> UInt8[ndarray, "H W 3"]:
        """Return a picture of some keyframes beside the map's rendering."""

    def trajectory_error(self, estimated: Trajectory, reference: Trajectory) -> TrajectoryError | None:
        """Return the error of a trajectory; None with too few poses at times of the reference."""
