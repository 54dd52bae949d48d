"""Report depth that cannot be right: nothing in reach of the mapper, or all of it before the lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gausslite.domain.errors import DatasetError
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.runner import MissionResult

_LEAST_DEPTH_M = 0.05
_ADVICE = "check the depth unit, `scale` in cam_params.json"


def require_mappable_depth(source: str, result: MissionResult, keyframes: Sequence[Keyframe]) -> None:
    """Raise DatasetError for frames that gave no Gaussian: without depth, or with depth too far away."""
    if result.totals.frames == 0:
        raise DatasetError(f"{source}: expected frames with depth, got none in {result.processed}")
    if result.stopped_by is None:
        raise DatasetError(
            f"{source}: expected surfaces in reach, got none in {result.processed} frames with a median depth of "
            f"{_median_depth_m(keyframes):.3g} m; {_ADVICE}"
        )


def depth_notes(keyframes: Sequence[Keyframe]) -> tuple[str, ...]:
    """Return a note if the median depth is nearer than any depth camera measures."""
    median_m = _median_depth_m(keyframes)
    return (f"the median depth is {median_m:.2g} m; {_ADVICE}",) if median_m < _LEAST_DEPTH_M else ()


def _median_depth_m(keyframes: Sequence[Keyframe]) -> float:
    medians = [
        float(np.median(each.frame.depth_m[each.frame.depth_m > 0])) for each in keyframes if each.frame.has_depth
    ]
    return float(np.median(medians)) if medians else np.inf
