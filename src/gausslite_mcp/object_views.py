"""Find the pose that shows an object best: large, whole, and not through walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import inverse, transform_points
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite.render.rasterizer import Rendering
from gausslite_mcp.place import Scene

VIEW_CAMERA = Camera.centred(554.0, 640, 480)
"""A horizontal field of view of 60 degrees."""
_TRIAL_WIDTH_PX = 160
_DEPTH_SLACK_M, _DEPTH_SLACK_SHARE = 0.05, 0.03
"""What lies this much nearer than the object hides it: an expected depth is an average over overlapping Gaussians."""
_LARGE_SHARE = 0.1
"""Of the image; an object that covers more is not shown better."""
_NEAREST_M, _DISTANCE_RADII = 0.35, 3.2
"""Least distance of a camera from an object's middle, and the one from which it is shown large, in radii of its box."""
_MIN_OPACITY = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """A pose that looks at an object. visible: share of its outline that nothing hides and the image contains.

    score: what `best_view` compares; larger is better.
    """

    T_world_camera: Float64[ndarray, "4 4"]
    camera: Camera
    visible: float
    score: float
    distance_m: float


class ObjectSight:
    """Says how well poses show one object: its own Gaussians alone, against the whole map."""

    def __init__(self, scene: Scene, landmark: ObjectLandmark, camera: Camera = VIEW_CAMERA) -> None:
        """Raises InvalidInputError if the map has nothing in the object's box."""
        gaussians = scene.splats.gaussians
        own = landmark.extent_m.contains(gaussians.means_m) & (gaussians.opacities > _MIN_OPACITY)
        if not own.any():
            raise InvalidInputError(f"object {landmark.object_id}: expected Gaussians of the map in its box, got none")
        self._scene, self._camera = scene, camera
        self._own = MapViewer(gaussians.take(own), CpuRasterizer(scene.threads))
        self.middle_m: Float64[ndarray, "3"] = 0.5 * np.add(landmark.extent_m.min_m, landmark.extent_m.max_m)
        self.radius_m = 0.5 * float(np.linalg.norm(landmark.size_m))
        self._corners_m = landmark.corners_m

    def look(self, eye_m: Float64[ndarray, "3"]) -> ObjectView:
        """Return the view of the object's middle from a point."""
        T = look_at(eye_m, self.middle_m, np.array(self._scene.up_axis))
        small = self._camera.narrower(_TRIAL_WIDTH_PX)
        alone, whole = self._own.render(small, T), self._scene.render(small, T)
        outline = alone.alpha > 0.5
        shown = outline & ~_hidden(alone, whole)
        inside = self._share_inside(small, T)
        visible = inside * float(shown.sum()) / max(int(outline.sum()), 1)
        size = min(1.0, float(shown.mean()) / _LARGE_SHARE)
        mapped = float((whole.alpha > 0.5).mean())
        distance_m = float(np.linalg.norm(eye_m - self.middle_m))
        return ObjectView(T, self._camera, visible, visible * np.sqrt(size) * mapped, distance_m)

    def _share_inside(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> float:
        """Return the share of the box's corners in the image."""
        x, y, z = transform_points(inverse(T_world_camera), self._corners_m).T
        columns, rows = camera.pixels(x / np.maximum(z, 1e-6), y / np.maximum(z, 1e-6))
        inside = (z > 0) & (columns >= 0) & (columns < camera.width_px) & (rows >= 0) & (rows < camera.height_px)
        return float(inside.mean())


def best_view(scene: Scene, landmark: ObjectLandmark) -> ObjectView:
    """Return the view that shows the object best, of those from where a keyframe saw the map, or nearer on its ray.

    A map is good only where it was seen from; without keyframes, points around the object are tried. Raises
    InvalidInputError, MismatchError if the object is visible from none of them.
    """
    sight = ObjectSight(scene, landmark)
    views = [sight.look(eye_m) for eye_m in _viewpoints(scene, sight)]
    best = max(views, key=lambda view: view.score)
    if best.visible == 0.0:
        raise MismatchError(f"object {landmark.object_id}: expected a place that sees it, got none of {len(views)}")
    return best


def _viewpoints(scene: Scene, sight: ObjectSight) -> list[Float64[ndarray, "3"]]:
    wanted_m = max(_NEAREST_M, _DISTANCE_RADII * sight.radius_m)
    if not scene.views:
        up = np.array(scene.up_axis)
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        side /= np.linalg.norm(side)
        angles_rad = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        level = np.cos(angles_rad)[:, None] * side + np.sin(angles_rad)[:, None] * np.cross(up, side)
        directions = np.concatenate([level * np.cos(tilt) + up * np.sin(tilt) for tilt in (0.25, 0.7)])
        return list(sight.middle_m + wanted_m * directions)
    found = []
    for view in scene.views:
        ray = view.T_world_camera[:3, 3] - sight.middle_m
        distance_m = float(np.linalg.norm(ray))
        if distance_m >= _NEAREST_M:
            found += [sight.middle_m + ray]
        if distance_m > 1.2 * wanted_m:
            nearer_m = wanted_m, (wanted_m * distance_m) ** 0.5
            found += [sight.middle_m + ray * (at_m / distance_m) for at_m in nearer_m]
    return found


def _hidden(alone: Rendering, whole: Rendering) -> ndarray:
    """Return where something lies before the object."""
    depth_m, first_m = alone.expected_depth_m(), whole.expected_depth_m()
    return (first_m > 0) & (first_m < depth_m * (1 - _DEPTH_SLACK_SHARE) - _DEPTH_SLACK_M)


def look_at(
    eye_m: Float64[ndarray, "3"], target_m: Float64[ndarray, "3"], up: Float64[ndarray, "3"]
) -> Float64[ndarray, "4 4"]:
    """Return the pose of a camera without roll. Raises InvalidInputError if the points are the same."""
    forward = target_m - eye_m
    length_m = float(np.linalg.norm(forward))
    if length_m < 1e-6:
        raise InvalidInputError("camera: expected a position away from what it looks at, got the same point")
    forward = forward / length_m
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # straight up or down
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye_m
    return T
