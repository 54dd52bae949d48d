"""What mapping at a rate costs in quality: the same frames and seed, in time and with all the time there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.domain.gaussians import Gaussians
from gausslite.errors import DatasetError
from gausslite.evaluation.compare import evaluate
from gausslite.evaluation.views import HeldOutView
from gausslite.render.rasterizer import Rasterizer


@dataclass(frozen=True, slots=True)
class RateGap:
    """ROI PSNR on held-out views of the map made at the rate, and of the one with `iterations` iterations a frame."""

    iterations: int
    views: int
    in_time_db: float
    unlimited_db: float

    @property
    def gap_db(self) -> float:
        """What the rate costs."""
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
        """Score both maps. Raises DatasetError when no view shows the region."""
        first, second = (evaluate(gaussians, views, rasterizer) for gaussians in (in_time, unlimited))
        if first.roi_psnr is None or second.roi_psnr is None:
            raise DatasetError("bench: expected a held-out frame that shows the region, got none")
        return cls(iterations, first.n_roi_views, first.roi_psnr, second.roi_psnr)
