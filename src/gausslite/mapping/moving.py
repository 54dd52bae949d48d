"""Which pixels of a frame show things that move: earlier frames saw through the place where they are now."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.camera import lift
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.mapping.free_space import DepthView

MOTION_REFERENCES = 8
"""The latest keyframes that are compared."""
_MIN_REFERENCES = 2
"""Those that must have seen through the place of a pixel that shows a thing that moves."""
_DEPTH_SLACK_M, _DEPTH_SLACK_SHARE = 0.1, 0.05
"""How much farther their depth is; the sum counts."""
_COLUMNS = 80
"""Pixels of a row that are compared."""
_MIN_PART, _GROWN = 9, 1
"""Compared pixels from which a part of the image counts, and its margin in their distances."""


def moving_pixels(frame: Frame, earlier: Sequence[Frame]) -> Bool[ndarray, "h w"]:
    """Return True for the pixels that show a thing that moves. earlier: frames with poses, oldest first.

    A place that earlier frames did not show, or that was behind something, shows no motion.
    """
    height, width = frame.depth_m.shape
    step = max(1, width // _COLUMNS)
    depth_m = frame.depth_m[::step, ::step]
    rows, columns = np.nonzero(depth_m > 0)
    points = lift(
        np.stack([columns, rows], axis=1) * step + 0.5, depth_m[rows, columns].astype(np.float64), frame.camera
    )
    p_world = transform_points(frame.T_world_camera, points).astype(np.float32)
    count = np.zeros(len(p_world), np.int64)
    for reference in earlier[-MOTION_REFERENCES:]:
        view = DepthView.of_frame(reference)
        count += view.sees_through(p_world, _DEPTH_SLACK_M, _DEPTH_SLACK_SHARE)
    grid = np.zeros(depth_m.shape, np.uint8)
    grid[rows, columns] = count >= _MIN_REFERENCES
    # single pixels are at depth edges
    opened = cv2.morphologyEx(grid, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    parts, labels, sizes, _ = cv2.connectedComponentsWithStats(opened)
    large = [label for label in range(1, parts) if sizes[label, cv2.CC_STAT_AREA] >= _MIN_PART]
    shown = cv2.dilate(np.isin(labels, large).astype(np.uint8), np.ones((2 * _GROWN + 1,) * 2, np.uint8))
    return np.repeat(np.repeat(shown > 0, step, axis=0), step, axis=1)[:height, :width]
