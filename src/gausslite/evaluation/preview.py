"""Preview image of a finished map: keyframes with most of the task's region next to the map's renderings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.evaluation.pictures import arrange_grid, comparison_row
from gausslite.evaluation.views import MapViewer, largest_roi_per_segment

_ROWS = 3


def render_preview(
    viewer: MapViewer, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]
) -> UInt8[ndarray, "H W 3"]:
    """Return an image with one row per third of the mission, in the keyframes' refined poses and exposures.

    keyframes: frames in temporal order, each with the mask of the task's region. The map was trained on these views,
    so they do not show its quality from other viewpoints.
    """
    roi_pixels = [int(np.count_nonzero(roi)) for _, roi in keyframes]
    chosen = largest_roi_per_segment(roi_pixels, _ROWS)
    rows = []
    for frame, roi in (keyframes[i] for i in sorted(chosen)):
        rendering = viewer.render_frame(frame)
        rows.append(comparison_row(frame.rgb, rendering.rgb, roi, f"frame {frame.index}"))
    return arrange_grid(rows)
