"""Trajectories, keyframe frusta and named objects in the scene."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.view.colours import category_colour
from gausslite.view.contents import AgentPath, ViewContents
from gausslite.view.label_layout import label_positions_m, label_text
from gausslite.view.local_server import LocalServer
from gausslite.view.start_view import StartView

_MAX_FRUSTA = 60
_MAX_TEAM_FRUSTA = 20
"""Of each agent of a team."""
_MAX_TRAJECTORY_POINTS = 5000
_TRAJECTORY_RGB, _KEYFRAME_RGB, _ROBOT_RGB = (40, 90, 220), (90, 140, 230), (220, 40, 40)
_TARGET_RGB, _ANCHOR_RGB = (20, 150, 60), (200, 130, 20)
_MIN_BOX_M = 0.01
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
            objects = contents.objects if self._switches["Objects"].value else ()
            self._replace("objects", self._objects(objects))
            views = contents.keyframes if self._switches["Keyframes"].value else ()
            views = views[:: max(1, -(-len(views) // _MAX_FRUSTA))]
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
            handles = [self._frustum("/robot", camera, contents.T_world_camera[frame], _ROBOT_RGB, 0.16)]
            self._replace("trajectory", [*handles, *self._line("/trajectory", points_m, _TRAJECTORY_RGB)])

    def _path(self, path: AgentPath) -> list[Any]:
        """Draw an agent's keyframes, the line through them, and the agent's name at the newest one."""
        colour, name, views = category_colour(path.colour_index), f"/team/{path.agent}", path.keyframes
        handles: list[Any] = []
        if views and self._switches["Keyframes"].value:
            shown = views[:: max(1, -(-len(views) // _MAX_TEAM_FRUSTA))]
            handles += [self._frustum(f"{name}/{v.index}", v.camera, v.T_world_camera, colour) for v in shown]
        if views and self._switches["Trajectory"].value:
            points_m = np.array([view.T_world_camera[:3, 3] for view in views], np.float32)
            handles += self._line(f"{name}/line", points_m, colour)
            handles.append(self._frustum(f"{name}/newest", views[-1].camera, views[-1].T_world_camera, colour, 0.16))
            handles.append(self._server.scene.add_label(f"{name}/label", path.agent, position=points_m[-1]))
        return handles

    def _line(self, name: str, points_m: Float32[ndarray, "n 3"], colour: tuple[int, int, int]) -> list[Any]:
        if len(points_m) < 2:
            return []
        segments = np.stack([points_m[:-1], points_m[1:]], axis=1)
        return [self._server.scene.add_line_segments(name, segments, colour, thickness=0.008)]

    def _objects(self, objects: Sequence[ObjectLandmark]) -> list[Any]:
        if self._view is None:
            return []
        labels_m = label_positions_m(objects, self._view)
        return [handle for i, each in enumerate(objects) for handle in self._object(i, each, labels_m[i])]

    def _object(self, index: int, landmark: ObjectLandmark, label_m: Float64[ndarray, "3"]) -> list[Any]:
        """Draw an object's box and its name, with a line between them if the name had to move up."""
        colour = _TARGET_RGB if landmark.role is ObjectRole.TARGET else _ANCHOR_RGB
        low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
        high = np.maximum(high, low + _MIN_BOX_M)
        scene, name = self._server.scene, f"/objects/{index}"
        inside_m = np.clip(label_m, low, high)
        edges_m = np.concatenate([_box_edges_m(low, high), np.stack([inside_m, label_m])[None].astype(np.float32)])
        # a label is drawn as text, never as HTML
        return [
            scene.add_line_segments(f"{name}/box", edges_m, colour, thickness=0.004),
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


def _box_edges_m(low: Float64[ndarray, "3"], high: Float64[ndarray, "3"]) -> Float32[ndarray, "12 2 3"]:
    """Return the ends of a box's edges: the pairs of corners that differ along one axis."""
    corners = list(product((0, 1), repeat=3))
    pairs = [(a, b) for a, b in combinations(corners, 2) if sum(i != j for i, j in zip(a, b, strict=True)) == 1]
    return np.where(np.array(pairs, bool), high, low).astype(np.float32)


def _wxyz(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    from viser.transforms import SO3

    wxyz: Float64[ndarray, "4"] = SO3.from_matrix(rotation).wxyz
    return wxyz
