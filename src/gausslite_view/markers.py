"""Trajectories, keyframe frusta and named objects in the scene, with names that do not cover each other."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite_view.contents import AgentPath, StartView, ViewContents, category_colour, object_boxes
from gausslite_view.local_server import LocalServer
from gausslite_view.oriented_box import OrientedBox

_FOV_RAD = np.deg2rad(75.0)
"""Vertical field of view of the page's camera, viser's default."""
_LINE, _LETTER = 0.03, 0.013
"""Height of a label and width of a letter, as shares of the window's height; for a window 700 pixels high."""
_NEAR_M = 0.1


def label_text(landmark: ObjectLandmark) -> str:
    """Return the object's name and confidence."""
    return f"{landmark.noun} {landmark.confidence:.2f}"


def label_positions_m(
    objects: Sequence[ObjectLandmark], boxes: Sequence[OrientedBox], view: StartView
) -> Float64[ndarray, "n 3"]:
    """Return where each object's label is: on its box, or higher if another label is there in this view."""
    up = np.array(view.up)
    tops_m = [np.array(box.centre_m) + up * np.ptp(box.corners_m @ up) / 2 for box in boxes]
    positions_m = np.array(tops_m).reshape(-1, 3)
    screen, depth_m = _project(positions_m, view)
    placed: list[tuple[float, float, float]] = []
    # from the bottom of the window to its top, so that a label that moves up meets only labels above it
    for i in np.argsort(screen[:, 1], kind="stable"):
        if depth_m[i] < _NEAR_M:
            continue
        width, height = _LETTER * len(label_text(objects[i])), _free_height(screen[i], objects[i], placed)
        placed.append((float(screen[i, 0]), height, width))
        positions_m[i] += up * _lift_m(positions_m[i], height - float(screen[i, 1]), view)
    return positions_m


def _free_height(
    at: Float64[ndarray, "2"], landmark: ObjectLandmark, placed: Sequence[tuple[float, float, float]]
) -> float:
    """Return the lowest height in the window, not below the label's own, that no placed label (x, y, width) covers."""
    width, height = _LETTER * len(label_text(landmark)), float(at[1])
    beside = [y for x, y, other in placed if abs(x - float(at[0])) < (width + other) / 2]
    for taken in sorted(beside):
        if abs(taken - height) < _LINE:
            height = taken + _LINE
    return height


def _lift_m(position_m: Float64[ndarray, "3"], rise: float, view: StartView) -> float:
    """Return how far a point moves along the world's up axis if its image rises by this share of the window."""
    _, camera_up, forward = _axes(view)
    up, offset_m = np.array(view.up), position_m - np.array(view.position_m)
    target = (offset_m @ camera_up) / (offset_m @ forward) + rise * 2 * np.tan(_FOV_RAD / 2)
    # (offset + s up) @ camera_up = target (offset + s up) @ forward
    slope = up @ camera_up - target * (up @ forward)
    lift_m: float = float((target * (offset_m @ forward) - offset_m @ camera_up) / slope) if slope > 1e-3 else 0.0
    return lift_m


def _project(
    points_m: Float64[ndarray, "n 3"], view: StartView
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, " n"]]:
    """Return the places in the window as shares of its height, x to the right and y up, and the depths."""
    right, camera_up, forward = _axes(view)
    offsets_m = points_m - np.array(view.position_m)
    depth_m = offsets_m @ forward
    scale = np.maximum(depth_m, _NEAR_M) * 2 * np.tan(_FOV_RAD / 2)
    return np.stack([offsets_m @ right, offsets_m @ camera_up], axis=1) / scale[:, None], depth_m


def _axes(view: StartView) -> tuple[Float64[ndarray, "3"], Float64[ndarray, "3"], Float64[ndarray, "3"]]:
    """Return the camera's right, up and forward axes."""
    forward = np.subtract(view.look_at_m, view.position_m)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.array(view.up))
    right /= max(float(np.linalg.norm(right)), 1e-9)
    return right, np.cross(right, forward), forward


_MAX_FRUSTA = 6
_MAX_TEAM_FRUSTA = 3
"""Of each agent of a team."""
_CLEAR = 0.7
"""Around the start view's camera, within this share of the way to its focus, no marker of a camera is drawn."""
_MAX_TRAJECTORY_POINTS = 5000
_TRAJECTORY_RGB, _KEYFRAME_RGB, _ROBOT_RGB = (40, 90, 220), (90, 140, 230), (220, 40, 40)
_BOX_STYLES = {
    ObjectRole.TARGET: ((20, 150, 60), 0.004),
    ObjectRole.ANCHOR: ((200, 130, 20), 0.002),
    ObjectRole.OTHER: ((130, 130, 130), 0.001),
}
"""Colour of a box's lines, and their thickness in metres."""
_MIN_BOX_M = 0.01
_EDGES = [pair for pair in combinations(range(8), 2) if (pair[0] ^ pair[1]).bit_count() == 1]
"""The pairs of a box's corners that differ along one side."""
_UNKNOWN_CAMERA = Camera(525.0, 525.0, 320.0, 240.0, 640, 480)


class SceneMarkers:
    """Owns the scene's markers and their controls. Thread-safe."""

    def __init__(self, server: LocalServer) -> None:
        self._server = server
        self._lock = threading.RLock()
        self._contents: ViewContents | None = None
        self._view: StartView | None = None
        self._until_ns: int | None = None
        self._drawn: dict[str, list[Any]] = {}
        gui = server.gui
        with gui.add_folder("Markers"):
            self._switches = {name: gui.add_checkbox(name, True) for name in ("Trajectory", "Keyframes", "Objects")}
        for switch in self._switches.values():
            switch.on_update(lambda _: self._draw_all())

    def show(self, contents: ViewContents, view: StartView | None, until_ns: int | None = None) -> None:
        """Replace the markers. view: where browsers start; until_ns: the trajectory's end, None for all of it."""
        with self._lock:
            self._contents, self._view, self._until_ns = contents, view, until_ns
            self._draw_all()

    def end_trajectory(self, until_ns: int | None) -> None:
        """Draw the trajectory up to this time only; None for all of it."""
        with self._lock:
            self._until_ns = until_ns
            self._draw_robot()

    def _draw_all(self) -> None:
        with self._lock:
            contents = self._contents
            if contents is None:
                return
            self._replace("objects", self._objects(contents) if self._switches["Objects"].value else [])
            views = self._spread(contents.keyframes, _MAX_FRUSTA)
            frusta = [self._frustum(f"/keyframes/{v.index}", v.camera, v.T_world_camera, _KEYFRAME_RGB) for v in views]
            self._replace("keyframes", frusta)
            self._replace("team", [handle for path in contents.paths for handle in self._path(path)])
            self._draw_robot()

    def _draw_robot(self) -> None:
        """Draw the trajectory up to the chosen time, and the camera there."""
        with self._lock:
            contents = self._contents
            if contents is None or len(contents.times_ns) < 2 or not self._switches["Trajectory"].value:
                self._replace("trajectory", [])
                return
            frame = len(contents.times_ns) - 1
            if self._until_ns is not None:
                frame = max(0, int(np.searchsorted(contents.times_ns, self._until_ns, side="right")) - 1)
            step = max(1, -(-(frame + 1) // _MAX_TRAJECTORY_POINTS))
            points_m = contents.T_world_camera[: frame + 1 : step, :3, 3].astype(np.float32)
            camera = contents.keyframes[0].camera if contents.keyframes else _UNKNOWN_CAMERA
            handles = self._line("/trajectory", points_m, _TRAJECTORY_RGB)
            if self._is_clear(points_m[-1:]).all():
                handles.append(self._frustum("/robot", camera, contents.T_world_camera[frame], _ROBOT_RGB, 0.16))
            self._replace("trajectory", handles)

    def _path(self, path: AgentPath) -> list[Any]:
        """Draw an agent's keyframes, the line through them, and the agent's name at the newest one."""
        colour, name, views = category_colour(path.colour_index), f"/team/{path.agent}", path.keyframes
        handles: list[Any] = []
        shown = self._spread(views, _MAX_TEAM_FRUSTA)
        handles += [self._frustum(f"{name}/{v.index}", v.camera, v.T_world_camera, colour) for v in shown]
        if views and self._switches["Trajectory"].value:
            points_m = np.array([view.T_world_camera[:3, 3] for view in views], np.float32)
            handles += self._line(f"{name}/line", points_m, colour)
            if self._is_clear(points_m[-1:]).all():
                handles.append(
                    self._frustum(f"{name}/newest", views[-1].camera, views[-1].T_world_camera, colour, 0.16)
                )
            handles.append(self._server.scene.add_label(f"{name}/label", path.agent, position=points_m[-1]))
        return handles

    def _line(self, name: str, points_m: Float32[ndarray, "n 3"], colour: tuple[int, int, int]) -> list[Any]:
        is_clear = self._is_clear(points_m)
        segments = np.stack([points_m[:-1], points_m[1:]], axis=1)[is_clear[:-1] & is_clear[1:]]
        if not len(segments):
            return []
        return [self._server.scene.add_line_segments(name, segments, colour, thickness=0.005)]

    def _spread(self, views: Sequence[KeyframeView], most: int) -> list[KeyframeView]:
        """Return at most this many keyframes, evenly spread, of those that do not cover the start view."""
        if not views or not self._switches["Keyframes"].value:
            return []
        is_clear = self._is_clear(np.array([view.T_world_camera[:3, 3] for view in views]))
        clear = [view for view, shown in zip(views, is_clear, strict=True) if shown]
        return clear[:: max(1, -(-len(clear) // most))]

    def _is_clear(self, points_m: np.ndarray) -> Bool[ndarray, " n"]:
        """Return which points are not near to the start view's camera, where markers would cover what it shows."""
        if self._view is None:
            return np.ones(len(points_m), np.bool_)
        eye_m = np.array(self._view.position_m)
        reach_m = float(np.linalg.norm(np.subtract(self._view.look_at_m, eye_m)))
        clear: Bool[ndarray, " n"] = np.linalg.norm(points_m - eye_m, axis=1) > _CLEAR * reach_m
        return clear

    def _objects(self, contents: ViewContents) -> list[Any]:
        if self._view is None:
            return []
        objects, boxes = contents.objects, object_boxes(contents)
        placed = zip(objects, boxes, label_positions_m(objects, boxes, self._view), strict=True)
        return [handle for i, of_object in enumerate(placed) for handle in self._object(i, *of_object)]

    def _object(
        self, index: int, landmark: ObjectLandmark, box: OrientedBox, label_m: Float64[ndarray, "3"]
    ) -> list[Any]:
        """Draw an object's box and its name, with a line between them if the name had to move up."""
        colour, thickness_m = _BOX_STYLES[landmark.role]
        corners_m = replace(box, size_m=tuple(np.maximum(box.size_m, _MIN_BOX_M).tolist())).corners_m
        scene, name = self._server.scene, f"/objects/{index}"
        inside_m = np.clip(label_m, corners_m.min(axis=0), corners_m.max(axis=0))
        edges_m = np.concatenate([corners_m[_EDGES], np.stack([inside_m, label_m])[None]]).astype(np.float32)
        # a label is drawn as text, never as HTML
        return [
            scene.add_line_segments(f"{name}/box", edges_m, colour, thickness=thickness_m),
            scene.add_label(f"{name}/label", label_text(landmark), position=label_m, anchor="bottom-center"),
        ]

    def _frustum(
        self,
        name: str,
        camera: Camera,
        T_world_camera: Float64[ndarray, "4 4"],
        colour: tuple[int, int, int],
        scale: float = 0.08,
    ) -> Any:
        return self._server.scene.add_camera_frustum(
            name,
            camera.vertical_fov_rad,
            camera.width_px / camera.height_px,
            scale=scale,
            thickness=0.004,
            color=colour,
            wxyz=_wxyz(T_world_camera[:3, :3]),
            position=T_world_camera[:3, 3],
        )

    def _replace(self, kind: str, handles: list[Any]) -> None:
        """Remove the markers of a kind that the new handles do not replace."""
        kept = {handle.name for handle in handles}
        for handle in self._drawn.pop(kind, []):
            if handle.name not in kept:
                handle.remove()
        self._drawn[kind] = handles


def _wxyz(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    from viser.transforms import SO3

    wxyz: Float64[ndarray, "4"] = SO3.from_matrix(rotation).wxyz
    return wxyz
