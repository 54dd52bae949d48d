"""Preview image of a finished map: keyframes with most of the task's region next to the map's renderings."""

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
    """Return an image with one row per third of the mission, in the keyframes' refined poses and exposures.

    The map was trained on these views, so they do not show its quality from other viewpoints.
    """
    roi_pixels = [int(np.count_nonzero(keyframe.relevance.roi)) for keyframe in keyframes]
    chosen = largest_roi_per_segment(roi_pixels, _ROWS)
    rows = []
    for keyframe in (keyframes[i] for i in sorted(chosen)):
        rendering = viewer.render_frame(keyframe.frame)
        label = f"frame {keyframe.frame.index}"
        rows.append(comparison_row(keyframe.frame.rgb, rendering.rgb, keyframe.relevance.roi, label))
    return arrange_grid(rows)
