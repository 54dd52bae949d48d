"""Keep what a container holds: the fruit in a bowl, which a detector leaves out of the bowl's mask."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.object_names import is_container

_DEPTH_SLACK_M: Final = 0.03
_DEPTH_PERCENTILES: Final = (2, 98)


def with_contents(phrase: str, mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a container's mask with the pixels inside its convex outline whose depth is that of the container.

    The masks of other objects are returned as they are.
    """
    known = depth_m[mask & (depth_m > 0)]
    if not is_container(phrase) or len(known) == 0:
        return mask
    rows, columns = np.nonzero(mask)
    outline = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1) > 0
    low_m, high_m = np.percentile(known, _DEPTH_PERCENTILES)
    is_near = (depth_m >= low_m - _DEPTH_SLACK_M) & (depth_m <= high_m + _DEPTH_SLACK_M)
    result: Bool[ndarray, "h w"] = mask | (hull & is_near)
    return result
