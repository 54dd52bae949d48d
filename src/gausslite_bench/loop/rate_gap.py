"""Quality lost to a frame rate: the same frames and seed mapped at the rate and without a time limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.domain.errors import DatasetError
from gausslite.domain.gaussians import Gaussians
from gausslite.render.rasterizer import Rasterizer
from gausslite_evaluation.compare import evaluate
from gausslite_evaluation.views import HeldOutView


@dataclass(frozen=True, slots=True)
class RateGap:
    """ROI PSNR of two maps on held-out views, in dB.

    in_time_db: of the map built at the rate; unlimited_db: of the map built without a time limit, with `iterations`
    iterations per frame; views: number of views that show the region.
    """

    iterations: int
    views: int
    in_time_db: float
    unlimited_db: float

    @property
    def gap_db(self) -> float:
        """Quality lost to the rate, in dB."""
        return self.unlimited_db - self.in_time_db

    @classmethod
    def of(
        cls,
        in_time: Gaussians,
        unlimited: Gaussians,
        iterations: int,
        views: Sequence[HeldOutView],
        rasterizer: Rasterizer,
    ) -> RateGap:
        """Return the scores of both maps. Raises DatasetError if no view shows the region."""
        at_rate, without_limit = (evaluate(gaussians, views, rasterizer) for gaussians in (in_time, unlimited))
        if at_rate.roi_psnr is None or without_limit.roi_psnr is None:
            raise DatasetError("bench: expected a held-out frame that shows the region, got none")
        return cls(iterations, at_rate.n_roi_views, at_rate.roi_psnr, without_limit.roi_psnr)
