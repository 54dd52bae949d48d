"""Times and results of the frames of one agent's mapping loop, from the image in memory to the updates to send."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import DatasetError
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mission.task_mapper import FrameOutcome

_PERCENTILES = {"p50_ms": 50, "p90_ms": 90, "p99_ms": 99, "max_ms": 100}


def loop_figures(outcomes: Sequence[FrameOutcome]) -> dict[str, object]:
    """Return the statistics of the mapped frames. Raises DatasetError without frames.

    hz: the loop's rate without waiting for frames.
    frames_under_trained: below the minimum of iterations. skipped_stages: frames that skipped the stage for lack of
    time. roi_share: mean share of the pixels that the task's region covers. gaussians: after the last frame.
    """
    if not outcomes:
        raise DatasetError("bench: expected at least one frame with depth, got none")
    timings = [outcome.timing for outcome in outcomes]
    seconds = np.array([timing.seconds for timing in timings])
    stages = {stage: np.array([timing.stages_s.get(stage, 0.0) for timing in timings]) for stage in Stage}
    iterations = [outcome.iterations for outcome in outcomes]
    return {
        "frames": len(outcomes),
        "hz": len(outcomes) / float(seconds.sum()),
        "iterations_mean": float(np.mean(iterations)),
        "iterations_min": min(iterations),
        "gaussians": outcomes[-1].gaussians,
        "roi_share": float(np.mean([outcome.roi_share for outcome in outcomes])),
        "latency": _percentiles(seconds),
        "stages": {stage.value: _percentiles(times) for stage, times in stages.items()},
        "frames_under_trained": sum(timing.under_trained for timing in timings),
        "skipped_stages": {
            stage.value: sum(stage in timing.skipped_stages for timing in timings) for stage in SkippableStage
        },
    }


def _percentiles(seconds: Float64[ndarray, " n"]) -> dict[str, float]:
    """Return the interpolated percentiles in milliseconds."""
    return {name: 1e3 * float(np.percentile(seconds, percent)) for name, percent in _PERCENTILES.items()}
