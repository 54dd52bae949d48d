"""A finished map at a glance: the keyframes that show most of the task's region, and the map drawn from there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.evaluation.pictures import arrange_grid, comparison_row
from gausslite.evaluation.views import MapViewer, largest_roi_per_segment
from gausslite.mapping.keyframes import Keyframe

_ROWS = 3


def render_preview(viewer: MapViewer, keyframes: Sequence[Keyframe]) -> UInt8[ndarray, "H W 3"]:
    """One row for each third of the mission, in the poses and colours that keyframes were mapped with.

    These are views the map was trained on: they show what it has, and say nothing of how it looks from elsewhere.
    """
    chosen = largest_roi_per_segment([int(np.count_nonzero(each.relevance.roi)) for each in keyframes], _ROWS)
    rows = []
    for keyframe in (keyframes[i] for i in sorted(chosen)):
        drawn = viewer.render_frame(keyframe.frame)
        label = f"frame {keyframe.frame.index}"
        rows.append(comparison_row(keyframe.frame.rgb, drawn.rgb, keyframe.relevance.roi, label))
    return arrange_grid(rows)
