"""Reject boxes that are too large for their object: by the measured extent in metres, or by the share of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.object_names import is_furniture, is_generic, is_medium, is_surface

Box = tuple[float, float, float, float]

_MAX_SAMPLES_PER_SIDE: Final = 64
_MIN_SAMPLES: Final = 8
_MIN_KNOWN_SHARE: Final = 0.1
# the nearer part of a box shows the object, the rest may show what is behind it
_DEPTH_PERCENTILE: Final = 25
_NEUTRAL_SCORE: Final = 0.5


@dataclass(frozen=True, slots=True)
class BoxSizeLimits:
    """Largest plausible objects: the longer side of a box in metres, or its share of an image without depth.

    The limit in metres holds for a score of 0.5 and is multiplied by 0.5 + score: a confident detection may be larger.
    The shares are those of the comment in Sec. III-B.2. The paper applies them always; a real recording shows large
    near objects, such as a monitor at 0.6 m, in boxes that exceed them. `surface` is not in the paper.
    """

    small_m: float = 1.0
    medium_m: float = 1.2
    furniture_m: float = 3.0
    surface_m: float = 6.0
    small_share: float = 0.20
    furniture_share: float = 0.40
    surface_share: float = 0.80

    def __post_init__(self) -> None:
        for name in ("small_m", "medium_m", "furniture_m", "surface_m"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(f"box limit {name}: expected a positive length, got {getattr(self, name)}")
        for name in ("small_share", "furniture_share", "surface_share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidInputError(f"box limit {name}: expected 0 to 1, got {getattr(self, name)}")

    def accepts(self, name: str, score: float, box_px: Box, frame: Frame) -> bool:
        """Return True if a box (left, top, right, bottom) is not too large for an object of this name."""
        limit_m, limit_share = self._limits(name)
        extent_m = box_extent_m(box_px, frame)
        if extent_m is not None:
            return extent_m <= limit_m * (_NEUTRAL_SCORE + score)
        left, top, right, bottom = box_px
        return (right - left) * (bottom - top) <= limit_share * frame.depth_m.size

    def _limits(self, name: str) -> tuple[float, float]:
        if is_surface(name):
            return self.surface_m, self.surface_share
        if is_medium(name):
            return self.medium_m, self.furniture_share
        if is_furniture(name) or is_generic(name):
            return self.furniture_m, self.furniture_share
        return self.small_m, self.small_share


def box_extent_m(box_px: Box, frame: Frame) -> float | None:
    """Return the longer side of a box at the depth of its nearer part, in metres; None if too few pixels have depth."""
    height, width = frame.depth_m.shape
    left, right = np.clip(np.array((np.floor(box_px[0]), np.ceil(box_px[2]))), 0, width).astype(int)
    top, bottom = np.clip(np.array((np.floor(box_px[1]), np.ceil(box_px[3]))), 0, height).astype(int)
    step = max(1, -(-max(right - left, bottom - top) // _MAX_SAMPLES_PER_SIDE))
    depths_m = frame.depth_m[top:bottom:step, left:right:step]
    known = depths_m[depths_m > 0]
    if len(known) < max(_MIN_SAMPLES, _MIN_KNOWN_SHARE * depths_m.size):
        return None
    side_per_m = max(frame.camera.unit_depth_size(box_px[2] - box_px[0], box_px[3] - box_px[1]))
    return float(side_per_m * np.percentile(known, _DEPTH_PERCENTILE))
