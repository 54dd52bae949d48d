"""Trajectory, keyframe frusta and named objects in the scene, and a scrub over the trajectory's time."""

from __future__ import annotations

import threading
from itertools import combinations, product
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.view.contents import ViewContents
from gausslite.view.local_server import LocalServer

_MAX_FRUSTA = 60
_MAX_TRAJECTORY_POINTS = 5000
_TRAJECTORY_RGB, _KEYFRAME_RGB, _ROBOT_RGB = (40, 90, 220), (90, 140, 230), (220, 40, 40)
_TARGET_RGB, _ANCHOR_RGB = (20, 150, 60), (200, 130, 20)
_NS_PER_S = 1e9
_MIN_BOX_M = 0.01
_UNKNOWN_CAMERA = Camera(525.0, 525.0, 320.0, 240.0, 640, 480)


class SceneMarkers:
    """Owns the scene's markers and their controls. Thread-safe."""

    def __init__(self, server: LocalServer) -> None:
        self._server = server
        self._lock = threading.RLock()
        self._contents: ViewContents | None = None
        self._drawn: dict[str, list[Any]] = {}
        gui = server.gui
        with gui.add_folder("Markers"):
            self._switches = {name: gui.add_checkbox(name, True) for name in ("Trajectory", "Keyframes", "Objects")}
        with gui.add_folder("Time", visible=False) as self._time_folder:
            self._time: Any = gui.add_slider("Frame", 0, 1, 1, 1)
            self._seconds: Any = gui.add_text("Seconds", "", disabled=True)
        for switch in self._switches.values():
            switch.on_update(lambda _: self._draw_all())
        self._time.on_update(lambda _: self._draw_robot())

    def show(self, contents: ViewContents) -> None:
        """Replace the markers. The scrub stays at the newest frame if it was there."""
        with self._lock:
            at_end = int(self._time.value) >= int(self._time.max)
            self._contents = contents
            last = len(contents.times_ns) - 1
            self._time_folder.visible = last > 0
            if last > 0 and last != self._time.max:
                self._time.max = last
                if at_end:
                    self._time.value = last
            self._draw_all()

    def _draw_all(self) -> None:
        with self._lock:
            contents = self._contents
            if contents is None:
                return
            objects = contents.objects if self._switches["Objects"].value else ()
            self._replace("objects", [handle for i, each in enumerate(objects) for handle in self._object(i, each)])
            views = contents.keyframes if self._switches["Keyframes"].value else ()
            views = views[:: max(1, -(-len(views) // _MAX_FRUSTA))]
            frusta = [self._frustum(f"/keyframes/{v.index}", v.camera, v.T_world_camera, _KEYFRAME_RGB) for v in views]
            self._replace("keyframes", frusta)
            self._draw_robot()

    def _draw_robot(self) -> None:
        """Draw the trajectory up to the chosen frame, and the camera there."""
        with self._lock:
            contents = self._contents
            if contents is None or len(contents.times_ns) < 2 or not self._switches["Trajectory"].value:
                self._replace("trajectory", [])
                return
            frame = min(int(self._time.value), len(contents.times_ns) - 1)
            self._seconds.value = f"{(contents.times_ns[frame] - contents.times_ns[0]) / _NS_PER_S:.2f}"
            step = max(1, -(-(frame + 1) // _MAX_TRAJECTORY_POINTS))
            points_m = contents.T_world_camera[: frame + 1 : step, :3, 3].astype(np.float32)
            camera = contents.keyframes[0].camera if contents.keyframes else _UNKNOWN_CAMERA
            handles = [self._frustum("/robot", camera, contents.T_world_camera[frame], _ROBOT_RGB, 0.16)]
            if len(points_m) > 1:
                segments = np.stack([points_m[:-1], points_m[1:]], axis=1)
                handles.append(
                    self._server.scene.add_line_segments("/trajectory", segments, _TRAJECTORY_RGB, thickness=0.008)
                )
            self._replace("trajectory", handles)

    def _object(self, index: int, landmark: ObjectLandmark) -> list[Any]:
        colour = _TARGET_RGB if landmark.role is ObjectRole.TARGET else _ANCHOR_RGB
        low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
        high = np.maximum(high, low + _MIN_BOX_M)
        scene, name = self._server.scene, f"/objects/{index}"
        # a label is drawn as text, never as HTML
        return [
            scene.add_line_segments(f"{name}/box", _box_edges_m(low, high), colour, thickness=0.004),
            scene.add_label(
                f"{name}/label",
                f"{landmark.noun} {landmark.confidence:.2f}",
                position=(low + high) / 2,
                anchor="bottom-center",
            ),
        ]

    def _frustum(
        self,
        name: str,
        camera: Camera,
        T_world_camera: Float64[ndarray, "4 4"],
        colour: tuple[int, int, int],
        scale: float = 0.08,
    ) -> Any:
        fov_rad = 2 * np.arctan(camera.height_px / (2 * camera.fy_px))
        return self._server.scene.add_camera_frustum(
            name,
            float(fov_rad),
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
