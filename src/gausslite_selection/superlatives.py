"""Select the largest, the highest or the leftmost of the objects of one noun."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.task import Superlative
from gausslite.perception.object_map import Landmark

_Measure = Callable[[Landmark, Float64[ndarray, "3"], Float64[ndarray, "4 4"]], float]


def select_extreme(
    landmarks: Sequence[Landmark],
    superlative: Superlative,
    up: Float64[ndarray, "3"],
    T_world_camera: Float64[ndarray, "4 4"],
) -> Landmark:
    """Return the landmark, of at least one of a noun, with the extreme value, seen from T_world_camera if needed."""
    measure, sign = _MEASURES[superlative]
    return max(landmarks, key=lambda landmark: sign * measure(landmark, up, T_world_camera))


def _diagonal_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up, T_world_camera
    return float(np.linalg.norm(_extents_m(landmark, np.eye(3))))


def _height_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del T_world_camera
    return float(_extents_m(landmark, up[None])[0])


def _width_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the larger horizontal extent."""
    del T_world_camera
    return float(_horizontal_extents_m(landmark, up).max())


def _thickness_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the smallest extent."""
    return float(min(_horizontal_extents_m(landmark, up).min(), _height_m(landmark, up, T_world_camera)))


def _level_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del T_world_camera
    return float(landmark.centroid_m @ up)


def _distance_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up
    return float(np.linalg.norm(landmark.centroid_m - T_world_camera[:3, 3]))


def _rightness_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up
    return float(transform_points(inverse(T_world_camera), landmark.centroid_m[None])[0, 0])


def _horizontal_extents_m(landmark: Landmark, up: Float64[ndarray, "3"]) -> Float64[ndarray, "2"]:
    across = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    across /= np.linalg.norm(across)
    return _extents_m(landmark, np.stack([across, np.cross(up, across)]))


def _extents_m(landmark: Landmark, axes: Float64[ndarray, "a 3"]) -> Float64[ndarray, " a"]:
    """Return the extent of the landmark's cells along each axis."""
    along_m: Float64[ndarray, "k a"] = landmark.footprint_m().astype(np.float64) @ axes.T
    extents: Float64[ndarray, " a"] = np.ptp(along_m, axis=0)
    return extents


_MEASURES: Final[Mapping[Superlative, tuple[_Measure, float]]] = {
    Superlative.LARGEST: (_diagonal_m, 1.0),
    Superlative.SMALLEST: (_diagonal_m, -1.0),
    Superlative.TALLEST: (_height_m, 1.0),
    Superlative.SHORTEST: (_height_m, -1.0),
    Superlative.LONGEST: (_width_m, 1.0),
    Superlative.WIDEST: (_width_m, 1.0),
    Superlative.NARROWEST: (_width_m, -1.0),
    Superlative.THICKEST: (_thickness_m, 1.0),
    Superlative.THINNEST: (_thickness_m, -1.0),
    Superlative.HIGHEST: (_level_m, 1.0),
    Superlative.LOWEST: (_level_m, -1.0),
    Superlative.RIGHTMOST: (_rightness_m, 1.0),
    Superlative.LEFTMOST: (_rightness_m, -1.0),
    Superlative.FARTHEST: (_distance_m, 1.0),
    Superlative.NEAREST: (_distance_m, -1.0),
}
