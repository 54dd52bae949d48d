"""Depth images without the pixels beside depth jumps."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_MIN_RELATIVE_JUMP = 0.04
_NEIGHBOURS = np.ones((3, 3), np.uint8)


def without_depth_edges(depth_m: Float32[ndarray, "h w"], distance_px: int) -> Float32[ndarray, "h w"]:
    """Return a copy with depth 0 up to distance_px from a jump; with distance 0 the image itself.

    A jump is where measured depths of a pixel and its eight neighbours differ by more than 4 % of the pixel's. Sensors
    err there by centimetres to metres: the foreground is measured too large, and registration shifts its border.
    """
    if distance_px < 1:
        return depth_m
    measured = depth_m > 0
    farthest = cv2.dilate(depth_m, _NEIGHBOURS)
    nearest = cv2.erode(np.where(measured, depth_m, np.float32(np.inf)), _NEIGHBOURS)
    jumps = measured & (farthest - nearest > np.float32(_MIN_RELATIVE_JUMP) * depth_m)
    side = 2 * distance_px - 1
    near_jumps = cv2.dilate(jumps.view(np.uint8), np.ones((side, side), np.uint8))
    return np.where(near_jumps > 0, np.float32(0.0), depth_m)
