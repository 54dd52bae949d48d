"""What a language model may ask of a place: other tool's answer as JSON values or an image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.codec.json import graph_as_json
from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_instance
from gausslite.domain.errors import InvalidInputError
from gausslite.wire.channel import is_agent
from gausslite.wire.clients import AgentClient
from gausslite.wire.security import Tls
from gausslite_export.occupancy import FREE, OCCUPIED, UNKNOWN
from gausslite_mcp.context import relations_of
from gausslite_mcp.goals import GoalSettings, goal_near
from gausslite_mcp.object_views import VIEW_CAMERA, best_view, look_at
from gausslite_mcp.place import Place, Scene, ServicePlace, find_object
from gausslite_objects.edits import EditKind
from gausslite_objects.mapped_objects import as_json, select

_JPEG_QUALITY = 90
_FOV_DEG = (20.0, 120.0)
_DIGITS = 4
_MAX_POINTS = 1000
_CELLS = {UNKNOWN: "unknown", FREE: "free", OCCUPIED: "occupied"}


@dataclass(frozen=True, slots=True)
class PlaceTools:
    """Answers about one place. agent: address of the robot that tasks are assigned to, by default the place."""

    place: Place
    agent: str = ""
    tls: Tls | None = None

    def list_objects(self, question: str) -> dict[str, Any]:
        """Return the objects that a question means, or all, as `gausslite objects --json` prints them."""
        objects = self.place.objects()
        chosen, notes = select(objects, question)
        values = [as_json(found, objects) for found in chosen]
        return _rounded({"count": len(values), "objects": values, "notes": [*notes, *objects.notes]})

    def object_context(self, name: str) -> dict[str, Any]:
        """Return an object with the ids that it is near, on and under."""
        objects = self.place.objects()
        found = find_object(objects, name)
        others = [other.landmark for other in objects.objects]
        relations = relations_of(found.landmark, others, objects.up_axis)
        return _rounded({"object": as_json(found, objects), **relations})

    def list_areas(self) -> dict[str, Any]:
        """Return the named areas with the ids of the objects in each."""
        objects = self.place.objects()
        areas = [
            {
                **area.as_json(),
                "objects": [
                    found.landmark.object_id
                    for found in objects.objects
                    if area.contains(found.landmark.centroid_m, objects.up_axis)
                ],
            }
            for area in objects.areas
        ]
        return _rounded({"areas": areas})

    def edit_object(self, kind: str, name: str, value: str, author: str) -> dict[str, Any]:
        """Correct an object, or undo the edit of a number. Raises InvalidInputError, NotPermittedError."""
        if kind not in list(EditKind):
            raise InvalidInputError(f"kind: expected one of {', '.join(EditKind)}, got {kind[:40]!r}")
        object_id = name if kind == EditKind.UNDO else find_object(self.place.objects(), name).landmark.object_id
        entry = self.place.memory().edit(EditKind(kind), object_id, value, author)
        return {"edit": entry.number, "done": entry.describe()}

    def goal_near(
        self, name: str, distance_m: float, radius_m: float, from_m: Sequence[float] | None
    ) -> dict[str, Any]:
        """Return a pose on the floor that can be reached and looks at the object."""
        settings = GoalSettings(
            radius_m=_within("radius_m", radius_m, 0.0, 2.0), distance_m=_within("distance_m", distance_m, 0.0, 5.0)
        )
        settings = replace(settings, reach_m=max(settings.reach_m, settings.distance_m + 1.0))
        landmark = find_object(self.place.objects(), name).landmark
        start_m = None if from_m is None else _point("from_m", from_m)
        goal = goal_near(self.place.scene(), landmark, settings, start_m)
        values = {"object": landmark.object_id, "position_m": goal.position_m, "yaw_rad": goal.yaw_rad}
        figures = {"distance_m": goal.distance_m, "visible": goal.visible}
        return _rounded({**values, **figures, "T_world_camera": goal.T_world_camera.tolist()})

    def clearance(self, points_m: Sequence[Sequence[float]]) -> dict[str, Any]:
        """Return at each point the distance to the nearest obstacle along the floor, and what its cell is."""
        if not 0 < len(points_m) <= _MAX_POINTS:
            raise InvalidInputError(f"points_m: expected 1 to {_MAX_POINTS} points, got {len(points_m)}")
        grid = self.place.scene().floor()
        cells = [grid.cell_at(np.array(_point("points_m", point))) for point in points_m]
        distances_m = grid.distance_m
        return _rounded(
            {
                "cells": ["unknown" if cell is None else _CELLS[int(grid.cells[cell])] for cell in cells],
                "distances_m": [None if cell is None else _finite(distances_m[cell]) for cell in cells],
            }
        )

    def best_view(self, name: str) -> tuple[dict[str, Any], bytes]:
        """Return the view that shows an object best, and its image."""
        landmark, scene = find_object(self.place.objects(), name).landmark, self.place.scene()
        view = best_view(scene, landmark)
        values = {"object": landmark.object_id, "visible": view.visible, "distance_m": view.distance_m}
        return _rounded({**values, **_pose_values(view.T_world_camera)}), _image(
            scene, view.camera, view.T_world_camera
        )

    def render_view(
        self, position_m: Sequence[float], look_at_m: Sequence[float], fov_deg: float
    ) -> tuple[dict[str, Any], bytes]:
        """Return the image from a position toward a point, with the share that the map covers."""
        width_px = VIEW_CAMERA.width_px
        focal_px = 0.5 * width_px / math.tan(math.radians(_within("fov_deg", fov_deg, *_FOV_DEG)) / 2)
        camera, scene = Camera.centred(focal_px, width_px, VIEW_CAMERA.height_px), self.place.scene()
        eye_m, target_m = (np.array(_point(n, p)) for n, p in (("position_m", position_m), ("look_at_m", look_at_m)))
        T = look_at(eye_m, target_m, np.array(scene.up_axis))
        alpha = scene.render(camera.narrower(160), T).alpha
        return _rounded({"mapped": float((alpha > 0.5).mean()), **_pose_values(T)}), _image(scene, camera, T)

    def assign_task(self, task: str) -> dict[str, Any]:
        """Assign a task to the robot; returns its graph. Raises TaskError, InvalidInputError, NotPermittedError."""
        agent = self.agent or self.place.name
        if not self.agent and not (isinstance(self.place, ServicePlace) and is_agent(agent, self.tls)):
            raise InvalidInputError("assign_task: expected a server that was started with --agent HOST:PORT")
        require_instance("task", task, str, "a sentence as text")
        with AgentClient(agent, tls=self.tls) as client:
            return graph_as_json(client.assign_task(task))


def _pose_values(T_world_camera: Float64[ndarray, "4 4"]) -> dict[str, Any]:
    return {"position_m": T_world_camera[:3, 3].tolist(), "T_world_camera": T_world_camera.tolist()}


def _image(scene: Scene, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> bytes:
    """Return the rendering as a JPEG file."""
    rgb: Float32[ndarray, "h w 3"] = scene.render(camera, T_world_camera).rgb
    pixels = cv2.cvtColor(np.rint(rgb * 255).astype(np.uint8), cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1])


def _finite(distance_m: float) -> float | None:
    return float(distance_m) if math.isfinite(distance_m) else None


def _within(name: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise InvalidInputError(f"{name}: expected {low:g} to {high:g}, got {value}")
    return value


def _point(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    if len(values) != 3 or not all(math.isfinite(value) and abs(value) < 1e5 for value in values):
        raise InvalidInputError(f"{name}: expected three numbers in metres, got {list(values)[:5]}")
    return values[0], values[1], values[2]


def _rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return JSON values with numbers of four decimals: a model reads other digit."""
    return {key: _rounded_value(value) for key, value in values.items()}


def _rounded_value(value: Any) -> Any:
    if isinstance(value, dict):
        return _rounded(value)
    if isinstance(value, list | tuple):
        return [_rounded_value(entry) for entry in value]
    return round(value, _DIGITS) if isinstance(value, float) else value
