"""The plane that fits a mask's points best, to tell screens and boards from seats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

# the outermost points of a mask are often of other things
INNER_PERCENTILES: Final = (10.0, 90.0)
_MIN_PANEL_EXTENT_M: Final = 0.25
_MAX_PANEL_THICKNESS: Final = 0.06
_MAX_PANEL_LEAN: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class FittedPlane:
    """A plane through points: its unit normal, the extent of the points in it, and their thickness across it."""

    normal: Float64[ndarray, "3"]
    extent_m: float
    thickness_m: float

    @classmethod
    def of(cls, points_m: Float64[ndarray, "n 3"]) -> FittedPlane:
        """Return the plane through the centroid of at least one point that has the least squared distances.

        Extent and thickness are without the outer tenths of the points on both sides.
        """
        offsets_m = points_m - points_m.mean(axis=0)
        _, axes = np.linalg.eigh(offsets_m.T @ offsets_m)
        sides_m = np.ptp(np.percentile(offsets_m @ axes, INNER_PERCENTILES, axis=0), axis=0)
        return cls(axes[:, 0], float(np.hypot(sides_m[1], sides_m[2])), float(sides_m[0]))

    def is_panel(self, up: Float64[ndarray, "3"]) -> bool:
        """Return True if the points are thin and upright, as those of a screen. up: in the world.

        The back of a chair is curved or leans: in simulated homes its thickness is 0.06 of the extent or more, or its
        normal is 7 degrees or more from level.
        """
        is_thin = self.thickness_m <= _MAX_PANEL_THICKNESS * self.extent_m
        return is_thin and self.extent_m >= _MIN_PANEL_EXTENT_M and abs(float(self.normal @ up)) <= _MAX_PANEL_LEAN
