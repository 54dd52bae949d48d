"""Draw a map from above: a rendering with the camera's path, the objects of the task and a scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.evaluation.pictures import to_uint8
from gausslite.evaluation.views import MapViewer, view_map
from gausslite.report.elements import element, picture_url, styled
from gausslite.view.contents import ViewContents

_WIDTH_PX, _MAX_HEIGHT_PX = 480, 640
_MARGIN_M = 0.3
_DISTANCE_M = 100.0
"""Height of the camera above the map: the perspective differs from a parallel projection by a few percent."""
_MIN_OPACITY = 0.3
_BORDER_PERCENT = 1.0
_CEILING_PERCENTILE = 90.0
_ABOVE_CAMERA_M = 0.2
_MIN_EXTENT_M = 0.5
_MAX_PATH_POINTS = 400
_LABEL_GAP_PX = 4
_SCALES_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlanCamera:
    """A camera far above the map that looks down; maps of one world frame share it, so that their plans are aligned."""

    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    ceiling_m: float

    @classmethod
    def above(cls, contents: Sequence[ViewContents]) -> PlanCamera | None:
        """Return a camera that shows all maps; None if they hold no visible Gaussian."""
        axes = _plan_axes(contents)
        clouds = [each.gaussians.means_m[each.gaussians.opacities > _MIN_OPACITY] for each in contents]
        points = np.concatenate([cloud.astype(np.float64) for cloud in clouds]) @ axes.T
        paths = np.concatenate([each.T_world_camera[:, :3, 3] for each in contents]) @ axes.T
        if not len(points):
            return None
        if len(paths):
            ceiling_m = float(np.percentile(paths[:, 2], _CEILING_PERCENTILE)) + _ABOVE_CAMERA_M
        else:
            ceiling_m = float(np.percentile(points[:, 2], _CEILING_PERCENTILE))
        low, high = np.percentile(points[:, :2], (_BORDER_PERCENT, 100.0 - _BORDER_PERCENT), axis=0)
        if len(paths):
            low, high = np.minimum(low, paths[:, :2].min(axis=0)), np.maximum(high, paths[:, :2].max(axis=0))
        low, high = low - _MARGIN_M, high + _MARGIN_M
        return cls(_camera(high - low), _pose(axes, (low + high) / 2, ceiling_m), ceiling_m)

    def project(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
        """Return the pixels of points in world coordinates."""
        p_camera = (points_m - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3]
        x, y = (p_camera[:, :2] / p_camera[:, 2:]).T
        return np.stack(self.camera.pixels(x, y), axis=1)

    def below_ceiling(self, gaussians: Gaussians) -> Bool[ndarray, " n"]:
        """Return which Gaussians are below the ceiling, which would hide the rest."""
        down = self.T_world_camera[:3, 2]
        return np.asarray(gaussians.means_m @ -down < self.ceiling_m, np.bool_)


def plan_view(contents: ViewContents, gaussians: Gaussians, plan: PlanCamera, caption: str) -> Element:
    """Return a figure of Gaussians (the map's, in any colours) from above, with the map's path and objects."""
    viewer: MapViewer = view_map(gaussians.take(plan.below_ceiling(gaussians)))
    rendering = viewer.render(plan.camera, plan.T_world_camera)
    width, height = plan.camera.width_px, plan.camera.height_px
    image = element(
        "image", attributes={"href": picture_url(to_uint8(rendering.rgb)), "width": str(width), "height": str(height)}
    )
    parts = [image, *_path(contents, plan)]
    for landmark in contents.objects:
        parts += _marked_object(landmark, plan)
    drawing = element(
        "svg",
        *parts,
        *_scale_bar(plan.camera),
        attributes={"viewBox": f"0 0 {width} {height}", "role": "img", "aria-label": caption},
    )
    return element("figure", drawing, element("figcaption", caption))


def _plan_axes(contents: Sequence[ViewContents]) -> Float64[ndarray, "3 3"]:
    """Return the plan's right, forward and up as rows: up is the world axis nearest to the cameras' mean up."""
    cameras = [each.T_world_camera for each in contents if len(each.T_world_camera)]
    mean_up = -np.concatenate(cameras)[:, :3, 1].mean(axis=0) if cameras else np.array((0.0, 0.0, 1.0))
    axis = int(np.argmax(np.abs(mean_up)))
    up = np.zeros(3)
    up[axis] = -1.0 if mean_up[axis] < 0 else 1.0
    right = np.eye(3)[1 if axis == 0 else 0]
    return np.stack([right, np.cross(up, right), up])


def _camera(extent_m: Float64[ndarray, "2"]) -> Camera:
    extent_m = np.maximum(extent_m, _MIN_EXTENT_M)
    px_per_m = min(_WIDTH_PX / extent_m[0], _MAX_HEIGHT_PX / extent_m[1])
    width, height = (max(1, round(float(px_per_m * side))) for side in extent_m)
    return Camera.centred(float(px_per_m * _DISTANCE_M), width, height)


def _pose(axes: Float64[ndarray, "3 3"], centre_m: Float64[ndarray, "2"], ceiling_m: float) -> Float64[ndarray, "4 4"]:
    """Return the pose above the centre: the image's right, down and depth axes are right, -forward and -up."""
    right, forward, up = axes
    T = np.eye(4)
    T[:3, :3] = np.stack([right, -forward, -up], axis=1)
    T[:3, 3] = axes.T @ np.array((centre_m[0], centre_m[1], ceiling_m + _DISTANCE_M))
    return T


def _path(contents: ViewContents, plan: PlanCamera) -> list[Element]:
    positions = contents.T_world_camera[:, :3, 3]
    if not len(positions):
        return []
    shown = positions[np.unique(np.linspace(0, len(positions) - 1, _MAX_PATH_POINTS).astype(int))]
    pixels = plan.project(shown)
    line = {"class": "path", "points": " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)}
    start = {"class": "start", "cx": f"{pixels[0, 0]:.1f}", "cy": f"{pixels[0, 1]:.1f}", "r": "4"}
    return [element("polyline", attributes=line), element("circle", element("title", "start"), attributes=start)]


def _marked_object(landmark: ObjectLandmark, plan: PlanCamera) -> list[Element]:
    """Return the object's box, seen from above, with its name over it."""
    low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
    corners = np.array([np.where(choice, high, low) for choice in np.ndindex(2, 2, 2)])
    pixels = plan.project(corners)
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    box = {"x": f"{left:.1f}", "y": f"{top:.1f}", "width": f"{right - left:.1f}", "height": f"{bottom - top:.1f}"}
    name = {"class": "label", "x": f"{(left + right) / 2:.1f}", "y": f"{top - _LABEL_GAP_PX:.1f}"}
    role = "target" if landmark.role is ObjectRole.TARGET else "anchor"
    outline = element("rect", element("title", landmark.object_id), attributes={"class": role, **box})
    return [outline, element("text", landmark.object_id, attributes=name)]


def _scale_bar(camera: Camera) -> list[Element]:
    px_per_m = camera.length_px(1.0, _DISTANCE_M)
    length_m = max([each for each in _SCALES_M if each * px_per_m < camera.width_px / 3], default=_SCALES_M[0])
    x, y = 12, camera.height_px - 12
    points = f"{x},{y - 5} {x},{y} {x + length_m * px_per_m:.1f},{y} {x + length_m * px_per_m:.1f},{y - 5}"
    label = element("text", f"{length_m:g} m", attributes={"class": "label", "x": str(x + 6), "y": str(y - 6)})
    return [element("polyline", attributes={"class": "scale", "points": points}), styled("g", "scale-label", label)]
