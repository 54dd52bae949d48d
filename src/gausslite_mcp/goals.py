"""Find a place for a robot to stand and look at an object: free, reachable, near, with the object in view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import MismatchError
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import transform_points
from gausslite_export.occupancy import FREE, FloorGrid
from gausslite_mcp.object_views import ObjectSight
from gausslite_mcp.place import Scene

_SECTORS = 24
_MIN_VISIBLE = 0.2
_PER_METRE = 0.2
"""Visible share that outweighs a metre of difference from the wanted distance."""
_START_REACH_M = 1.0
"""The robot's cell is the free one nearest to it, within this distance: its own body or a table may cover its place."""


@dataclass(frozen=True, slots=True)
class GoalSettings:
    """How a robot stands. radius_m: of its body. distance_m: wanted between it and the object's box; reach_m: largest.

    eye_height_m: of its camera above the floor.
    """

    radius_m: float = 0.25
    distance_m: float = 0.8
    reach_m: float = 2.0
    eye_height_m: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Goal:
    """A place on the floor, in the map's frame. yaw_rad: of the robot's x axis, about the upward axis from x (as nav2).

    T_world_camera: the pose of its camera, looking at the object. visible: share of the object's outline in view.
    """

    position_m: tuple[float, float, float]
    yaw_rad: float
    T_world_camera: Float64[ndarray, "4 4"]
    distance_m: float
    visible: float


def goal_near(
    scene: Scene,
    landmark: ObjectLandmark,
    settings: GoalSettings = GoalSettings(),
    from_m: tuple[float, float, float] | None = None,
) -> Goal:
    """Return the place from which a robot at from_m sees the object best at about the wanted distance.

    from_m: by default the last keyframe's place; without keyframes, the largest free area counts as reachable.
    Raises InvalidInputError, MismatchError if no such place is known.
    """
    grid, sight = scene.floor(), ObjectSight(scene, landmark)
    start_m = scene.views[-1].T_world_camera[:3, 3] if from_m is None and scene.views else from_m
    reachable = _reachable(grid, settings.radius_m, None if start_m is None else np.array(start_m, np.float64))
    best: tuple[float, Goal] | None = None
    for place_m, distance_m in _candidates(grid, reachable, landmark, settings):
        goal = _goal(grid, sight, place_m, distance_m, settings)
        score = goal.visible - _PER_METRE * abs(distance_m - settings.distance_m)
        if goal.visible >= _MIN_VISIBLE and (best is None or score > best[0]):
            best = score, goal
    if best is None:
        count = int(reachable.sum())
        raise MismatchError(
            f"object {landmark.object_id}: expected a free place within {settings.reach_m:g} m that can be reached and "
            f"sees it, got none of {count} reachable cells"
        )
    return best[1]


def _reachable(grid: FloorGrid, radius_m: float, start_m: Float64[ndarray, "3"] | None) -> Bool[ndarray, "h w"]:
    """Return the free cells where the robot fits that are connected with its own, or the largest such area."""
    fits: Bool[ndarray, "h w"] = (grid.cells == FREE) & (grid.distance_m > radius_m)
    _, labels, figures, _ = cv2.connectedComponentsWithStats(fits.astype(np.uint8), connectivity=4)
    if not fits.any():
        return fits
    chosen = 1 + int(np.argmax(figures[1:, cv2.CC_STAT_AREA]))
    if start_m is not None:
        offsets_m = _centres(grid, np.argwhere(fits)) - transform_points(grid.T_upright_map, start_m)[:2]
        distances_m = np.linalg.norm(offsets_m, axis=1)
        if distances_m.min() > _START_REACH_M:
            return np.zeros_like(fits)
        row, column = np.argwhere(fits)[np.argmin(distances_m)]
        chosen = int(labels[row, column])
    return np.asarray(labels == chosen)


def _candidates(
    grid: FloorGrid, reachable: Bool[ndarray, "h w"], landmark: ObjectLandmark, settings: GoalSettings
) -> list[tuple[Float64[ndarray, "2"], float]]:
    """Return the place of each direction from the object whose distance is nearest to the wanted one."""
    corners_m = transform_points(grid.T_upright_map, landmark.corners_m)[:, :2]
    low_m, high_m = corners_m.min(axis=0), corners_m.max(axis=0)
    places_m = _centres(grid, np.argwhere(reachable))
    beside_m = np.maximum(0.0, np.maximum(low_m - places_m, places_m - high_m))
    distances_m = np.linalg.norm(beside_m, axis=1)
    near = (distances_m <= settings.reach_m) & (distances_m >= settings.radius_m)
    places_m, distances_m = places_m[near], distances_m[near]
    offsets_m = places_m - 0.5 * (low_m + high_m)
    sectors = ((np.arctan2(offsets_m[:, 1], offsets_m[:, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    order = np.argsort(np.abs(distances_m - settings.distance_m), kind="stable")
    _, first = np.unique(sectors[order], return_index=True)
    return [(places_m[i], float(distances_m[i])) for i in order[first]]


def _goal(
    grid: FloorGrid, sight: ObjectSight, place_m: Float64[ndarray, "2"], distance_m: float, settings: GoalSettings
) -> Goal:
    T_map_upright = grid.T_upright_map.T  # a rotation
    eye_m = transform_points(T_map_upright, np.array([*place_m, grid.floor_m + settings.eye_height_m]))
    view = sight.look(eye_m)
    x, y, z = transform_points(T_map_upright, np.array([*place_m, grid.floor_m])).tolist()
    toward = transform_points(grid.T_upright_map, sight.middle_m)[:2] - place_m
    return Goal((x, y, z), float(np.arctan2(toward[1], toward[0])), view.T_world_camera, distance_m, view.visible)


def _centres(grid: FloorGrid, cells: Int64[ndarray, "n 2"]) -> Float64[ndarray, "n 2"]:
    """Return the middles of cells (row, column) in x and y."""
    return grid.origin_m + (cells[:, ::-1] + 0.5) * grid.cell_m
