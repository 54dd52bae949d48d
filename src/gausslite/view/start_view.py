"""Choose where the page's camera starts: behind the robot's first keyframe, or beside a map without a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.view.contents import ViewContents

_BEHIND_M = 0.6
_BESIDE, _ABOVE = 0.5, 0.4
"""Distances from the map's centre along the horizontal axes and upwards, as shares of its extent."""
_MIN_EXTENT_M = 0.1
"""Of a map that is a point: the camera is never at the point that it looks at."""
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StartView:
    """Camera position, point that it looks at, and the up direction, in the world's frame."""

    position_m: Vector
    look_at_m: Vector
    up: Vector


def start_view(contents: ViewContents) -> StartView:
    """Return the start view of a map with Gaussians: a map without a trajectory, as a team's, is seen from beside."""
    poses = [keyframe.T_world_camera for keyframe in contents.keyframes] or list(contents.T_world_camera)
    up = _up(poses)
    low, centre, high = np.percentile(contents.gaussians.means_m.astype(np.float64), (5, 50, 95), axis=0)
    if not len(contents.times_ns):
        low = np.min([low, *(each.extent_m.min_m for each in contents.objects)], axis=0)
        high = np.max([high, *(each.extent_m.max_m for each in contents.objects)], axis=0)
        centre = 0.5 * (low + high)
        first_axis, second_axis = np.eye(3)[np.flatnonzero(up == 0)]
        offset = _BESIDE * (first_axis - second_axis) + _ABOVE * up
        extent_m = max(_MIN_EXTENT_M, float(np.linalg.norm(high - low)))
        return StartView(_vector(centre + extent_m * offset), _vector(centre), _vector(up))
    first = poses[0]
    forward = first[:3, 2]
    position = first[:3, 3] - _BEHIND_M * forward + 0.5 * _BEHIND_M * up
    distance_m = max(1.0, float(np.dot(centre - first[:3, 3], forward)))
    return StartView(_vector(position), _vector(first[:3, 3] + distance_m * forward), _vector(up))


def _up(poses: Sequence[Float64[ndarray, "4 4"]]) -> Float64[ndarray, "3"]:
    """Return the axis of the world that is closest to up in the cameras' images, z without cameras."""
    snapped = np.zeros(3)
    if not len(poses):
        snapped[2] = 1.0
        return snapped
    # images have y down, so the mean of the cameras' -y is up
    up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = int(np.argmax(np.abs(up)))
    snapped[axis] = 1.0 if up[axis] >= 0 else -1.0
    return snapped


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
