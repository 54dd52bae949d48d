"""Choose where the page's camera starts: behind the robot's first keyframe, or beside the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausslite.view.contents import ViewContents

_BEHIND_M = 0.6
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StartView:
    """Camera position, point that it looks at, and the up direction, in the world's frame."""

    position_m: Vector
    look_at_m: Vector
    up: Vector


def start_view(contents: ViewContents) -> StartView:
    """Return the start view of a map with Gaussians."""
    poses = [keyframe.T_world_camera for keyframe in contents.keyframes] or list(contents.T_world_camera)
    low, centre, high = np.percentile(contents.gaussians.means_m.astype(np.float64), (5, 50, 95), axis=0)
    if not poses:
        extent_m = float(np.linalg.norm(high - low))
        return StartView(_vector(centre + extent_m * np.array([0.5, -0.5, 0.4])), _vector(centre), (0.0, 0.0, 1.0))
    # images have y down, so the mean of the cameras' -y is up
    up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = int(np.argmax(np.abs(up)))
    snapped = np.zeros(3)
    snapped[axis] = 1.0 if up[axis] >= 0 else -1.0
    first = poses[0]
    forward = first[:3, 2]
    position = first[:3, 3] - _BEHIND_M * forward + 0.5 * _BEHIND_M * snapped
    distance_m = max(1.0, float(np.dot(centre - first[:3, 3], forward)))
    return StartView(_vector(position), _vector(first[:3, 3] + distance_m * forward), _vector(snapped))


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
