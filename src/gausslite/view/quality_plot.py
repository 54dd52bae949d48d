"""Plots of how well the map renders the newest keyframe, which it is trained on, in the task's region and in all."""

from __future__ import annotations

import math
from typing import Any

from jaxtyping import Bool, Shaped, UInt8
from numpy import ndarray

from gausslite.evaluation.metrics import psnr
from gausslite.view.history_plot import HistoryPlot


class QualityPlot:
    """PSNR of training views over time; use it from one thread. Exposure is not fitted."""

    def __init__(self, gui: Any) -> None:
        self._region = HistoryPlot(gui, "training PSNR, task's region (dB)", ["dB"])
        self._full = HistoryPlot(gui, "training PSNR, full image (dB)", ["dB"])

    def add(
        self,
        time_s: float,
        rendered: Shaped[ndarray, "h w 3"],
        rgb: UInt8[ndarray, "h w 3"],
        roi: Bool[ndarray, "h w"],
    ) -> None:
        """Add the PSNR of a rendering, uint8 or floating, against its image; no point for an empty region."""
        masks = ((self._full, None), (self._region, roi)) if roi.any() else ((self._full, None),)
        for plot, mask in masks:
            value_db = psnr(rendered, rgb, mask)
            if math.isfinite(value_db):
                plot.add(time_s, [value_db])
