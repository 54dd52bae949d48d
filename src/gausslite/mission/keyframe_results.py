"""Write the keyframes of a mission to its results folder: their cameras, and the photographs of a few."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gausslite.codec.keyframe_views import KeyframeView, write_keyframe_views
from gausslite.codec.view_images import ViewImage, write_view_images
from gausslite.evaluation.views import largest_roi_per_segment
from gausslite.mapping.keyframes import Keyframe

_PHOTOGRAPHS = 4


def write_keyframes(folder: Path, keyframes: Sequence[Keyframe]) -> None:
    """Write keyframes.json, and in `views` the photographs with the largest region of each quarter of the mission.

    keyframes: oldest first. Raises StorageError.
    """
    views = [_view(keyframe) for keyframe in keyframes]
    write_keyframe_views(folder, views)
    chosen = sorted(largest_roi_per_segment([view.roi_pixels for view in views], _PHOTOGRAPHS))
    write_view_images(folder, [_photograph(keyframes[i]) for i in chosen])


def _view(keyframe: Keyframe) -> KeyframeView:
    frame, pixels = keyframe.frame, int(np.count_nonzero(keyframe.relevance.roi))
    return KeyframeView(frame.index, frame.capture_time_ns, frame.camera, frame.T_world_camera, pixels)


def _photograph(keyframe: Keyframe) -> ViewImage:
    return ViewImage(keyframe.frame.index, keyframe.frame.rgb, keyframe.relevance.roi)
