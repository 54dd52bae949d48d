"""The smallest upright box around an object's corners, for pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import UpAxis

_CORNERS = np.array(list(np.ndindex(2, 2, 2)))


@dataclass(frozen=True, slots=True)
class OrientedBox:
    """An upright box. yaw_rad: of its longer level side, from the first level axis; size_m: along, across and up."""

    centre_m: tuple[float, float, float]
    yaw_rad: float
    size_m: tuple[float, float, float]
    vertical: int

    @classmethod
    def enclosing(cls, points_m: Float64[ndarray, "n 3"], up_axis: UpAxis) -> OrientedBox:
        """Return the smallest upright box around points, at least one."""
        vertical = int(np.argmax(np.abs(up_axis)))
        flat = [axis for axis in range(3) if axis != vertical]
        low, high = points_m.min(axis=0), points_m.max(axis=0)
        centre_m = 0.5 * (low + high)  # near it, float32 is exact enough
        offset_m, (width_m, depth_m), angle_deg = cv2.minAreaRect((points_m - centre_m)[:, flat].astype(np.float32))
        centre_m[flat] += offset_m
        if width_m < depth_m:
            width_m, depth_m, angle_deg = depth_m, width_m, angle_deg + 90.0
        x, y, z = centre_m.tolist()
        size_m = float(width_m), float(depth_m), float(high[vertical] - low[vertical])
        return cls((x, y, z), math.radians((angle_deg + 90.0) % 180.0 - 90.0), size_m, vertical)

    @property
    def corners_m(self) -> Float64[ndarray, "8 3"]:
        """The corners, in binary order of the sides along, across and up."""
        halves = (_CORNERS - 0.5) * self.size_m
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned = np.column_stack([halves[:, :2] @ ((cos, sin), (-sin, cos)), halves[:, 2]])
        order = [axis for axis in range(3) if axis != self.vertical] + [self.vertical]
        corners: Float64[ndarray, "8 3"] = np.array(self.centre_m) + turned[:, np.argsort(order)]
        return corners
