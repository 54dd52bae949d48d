"""Move a mask's outline to the colour edges next to it, with a guided filter (He et al., PAMI 2013)."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

_RADIUS_PX: Final = 2
_WINDOW: Final = (2 * _RADIUS_PX + 1, 2 * _RADIUS_PX + 1)
# colour variance, in squared shares of the Lab range, below which an edge is noise
_EPSILON: Final = 1e-4
_MIN_SHARE: Final = 0.5


def snapped_to_edges(mask: Bool[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    """Return the mask with the pixels within two pixels of its outline assigned to the side that has their colour."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return mask
    # a filtered pixel depends on pixels up to twice the radius away, and a changed pixel is one radius outside
    margin_px = 3 * _RADIUS_PX
    window = tuple(slice(max(0, int(at[0]) - margin_px), int(at[-1]) + margin_px + 1) for at in (rows, columns))
    part = mask[window]
    lab = cv2.cvtColor(np.ascontiguousarray(rgb[window]), cv2.COLOR_RGB2LAB).astype(np.float32) / np.float32(255)
    share = _guided_filter(lab, part.astype(np.float32))
    kernel = np.ones(_WINDOW, np.uint8)
    near_outline = cv2.dilate(part.astype(np.uint8), kernel) > cv2.erode(part.astype(np.uint8), kernel)
    snapped = mask.copy()
    snapped[window] = np.where(near_outline, share > _MIN_SHARE, part)
    return snapped


def _guided_filter(guide: Float32[ndarray, "h w 3"], values: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return the values as locally linear functions of the guide's three channels, fitted in each window."""
    guide_mean, value_mean = cv2.blur(guide, _WINDOW), cv2.blur(values, _WINDOW)
    products = cv2.blur(guide * values[..., None], _WINDOW) - guide_mean * value_mean[..., None]
    outer = (guide[..., :, None] * guide[..., None, :]).reshape(*values.shape, 9)
    variance = np.dstack([cv2.blur(np.ascontiguousarray(outer[..., i]), _WINDOW) for i in range(9)])
    variance = variance.reshape(*values.shape, 3, 3) - guide_mean[..., :, None] * guide_mean[..., None, :]
    slope = np.linalg.solve(variance + np.float32(_EPSILON) * np.eye(3, dtype=np.float32), products[..., None])[..., 0]
    offset = value_mean - (slope * guide_mean).sum(axis=-1)
    slope_mean = cv2.blur(np.ascontiguousarray(slope), _WINDOW)
    filtered: Float32[ndarray, "h w"] = (slope_mean * guide).sum(axis=-1) + cv2.blur(offset, _WINDOW)
    return filtered
