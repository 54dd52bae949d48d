"""Remove background from an object's mask: pixels that show a farther surface, such as between a chair's legs."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

_LOG_DEPTH_BIN: Final = 0.02
_GAP_BINS: Final = 2
_MIN_BIN_SHARE: Final = 0.005
_MIN_BIN_TO_PEAK: Final = 0.05
_MIN_LAYER_SHARE: Final = 0.15
_MIN_PIXELS: Final = 8


def foreground_mask(mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the nearest depth layer with a sufficient share of the mask; pixels without depth are kept.

    Layers are separated by at least two adjacent, almost empty bins. A bin covers 2 % of depth.
    """
    known = mask & (depth_m > 0)
    log_depths = np.log(depth_m[known])
    if len(log_depths) < _MIN_PIXELS:
        return mask
    bins = ((log_depths - log_depths.min()) / _LOG_DEPTH_BIN).astype(np.int64)
    counts = np.bincount(bins)
    filled = np.flatnonzero(counts > max(_MIN_BIN_SHARE * len(bins), _MIN_BIN_TO_PEAK * float(counts.max())))
    layer = np.cumsum(np.diff(filled, prepend=filled[0]) > _GAP_BINS)
    shares = np.bincount(layer, weights=counts[filled]) / len(bins)
    nearest = filled[layer == np.flatnonzero(shares >= min(_MIN_LAYER_SHARE, shares.max()))[0]]
    outside = (bins < nearest[0] - 1) | (bins > nearest[-1] + 1)
    front = mask.copy()
    front[known] = ~outside
    return front
