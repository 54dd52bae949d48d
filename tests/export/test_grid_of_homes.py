"""Grids of simulated homes, judged by a planner against the true geometry: paths touch nothing, and free is free."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from skimage.graph import MCP_Geometric

from gausslite.domain.camera import Camera
from gausslite.mapping.free_space import DepthView
from gausslite_export.occupancy import FREE, OCCUPIED, FloorGrid, OccupancySettings, planar_grid
from gausslite_export.surface_votes import count_votes
from gausslite_sim.home_catalogue import plan_home
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.scene import ray_caster_factory

pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
CELL_M, RADIUS_M, FINE_M = 0.05, 0.2, 0.01
LOW_M, HIGH_M = OccupancySettings().height_m
CAMERA = Camera.centred(136.0, 160, 120)
FRAMES, PATHS, STARTS = 60, 40, 4


def depth_views(plan: HomePlan, corners_m: np.ndarray, rng: np.random.Generator) -> list[DepthView]:
    """Return what a depth camera of moderate noise measures along the first trajectory."""
    cast = ray_caster_factory()(corners_m.astype(np.float32))
    x, y = CAMERA.slopes(*np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    views = []
    for T in plan.trajectories[0](FRAMES):
        directions = (rays @ T[:3, :3].T).astype(np.float32)
        origins = np.tile(T[:3, 3].astype(np.float32), (len(rays), 1))
        z = cast.run(origins, directions, output=True)["tfar"].reshape(120, 160)
        z = z + rng.normal(0, 1, z.shape) * (0.0012 + 0.0019 * (z - 0.4) ** 2)
        z[(rng.random(z.shape) < 0.05) | (z > 5.5)] = 0
        views.append(DepthView.of(z.astype(np.float32), CAMERA, T))
    return views


@dataclass(frozen=True, eq=False)
class Truth:
    """By the cells of a grid: what is occupied, what is free and connected with the camera, how far obstacles are."""

    occupied: np.ndarray
    free: np.ndarray
    distance_m: np.ndarray

    @classmethod
    def of(cls, plan: HomePlan, corners_m: np.ndarray, grid: FloorGrid) -> Truth:
        scale, shape = round(CELL_M / FINE_M), grid.cells.shape
        fine = np.ones((shape[0] * scale, shape[1] * scale), np.uint8)
        points_m = surface_samples(corners_m)
        points_m = points_m[(points_m[:, 2] >= LOW_M) & (points_m[:, 2] <= HIGH_M)]
        column, row = np.floor((points_m[:, :2] - grid.origin_m) / FINE_M).astype(int).T
        inside = (row >= 0) & (row < fine.shape[0]) & (column >= 0) & (column < fine.shape[1])
        fine[row[inside], column[inside]] = 0
        occupied = (fine.reshape(shape[0], scale, shape[1], scale) == 0).any(axis=(1, 3))
        distance_m = cv2.distanceTransform(fine, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * FINE_M
        labels = cv2.connectedComponents((~occupied).astype(np.uint8), connectivity=4)[1]
        seats = [labels[cell] for T in plan.trajectories[0](FRAMES) if (cell := grid.cell_at(T[:3, 3])) is not None]
        room = np.bincount([label for label in seats if label]).argmax()
        return cls(occupied, labels == room, distance_m[scale // 2 :: scale, scale // 2 :: scale])


def surface_samples(corners_m: np.ndarray) -> np.ndarray:
    """Return points at most a fine cell apart on all triangles."""
    sides_m = np.linalg.norm(corners_m - np.roll(corners_m, 1, axis=1), axis=2).max(axis=1)
    steps, found = np.maximum(np.ceil(sides_m / FINE_M).astype(int), 1), []
    for count in np.unique(steps):
        a, b, c = corners_m[steps == count].transpose(1, 0, 2)[:, :, None]
        u, v = (
            axis[np.add.outer(np.arange(count + 1), np.arange(count + 1)) <= count] / count
            for axis in np.mgrid[: count + 1, : count + 1]
        )
        found.append((a + u[:, None] * (b - a) + v[:, None] * (c - a)).reshape(-1, 3))
    return np.concatenate(found)


def paths(fits: np.ndarray, truth: Truth, rng: np.random.Generator) -> list[np.ndarray]:
    """Return the shortest paths that a planner finds between true places of the robot."""
    places = np.argwhere(truth.free & (truth.distance_m > RADIUS_M + CELL_M) & fits)
    found = []
    for start in places[rng.choice(len(places), STARTS)]:
        planner = MCP_Geometric(np.where(fits, 1.0, -1.0))
        costs, _ = planner.find_costs([tuple(start)])
        goals = places[rng.choice(len(places), PATHS // STARTS)]
        found += [np.array(planner.traceback(tuple(goal))) for goal in goals if np.isfinite(costs[tuple(goal)])]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_planner_finds_paths_that_touch_nothing_and_free_cells_are_free(number: int) -> None:
    plan, rng = plan_home(number, 0), np.random.default_rng(number)
    corners_m = np.concatenate([part.mesh.positions_m[part.mesh.faces] for item in plan.items for part in item.parts])
    votes = count_votes(depth_views(plan, corners_m, rng), CELL_M)
    grid = planar_grid(votes.surface(), votes.free(), OccupancySettings(CELL_M))
    truth, free, occupied = Truth.of(plan, corners_m, grid), grid.cells == FREE, grid.cells == OCCUPIED
    blocked_m = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    found = paths(blocked_m > RADIUS_M + CELL_M / 2, truth, rng)
    assert len(found) > PATHS / 2
    assert all(truth.distance_m[tuple(cells.T)].min() >= RADIUS_M for cells in found)
    assert free[truth.free].mean() > 0.55  # of home 4, half is never seen
    assert free[truth.occupied].mean() < 0.07
    assert occupied[truth.free].mean() < 0.05
    assert occupied[truth.free & (truth.distance_m > 2 * CELL_M)].mean() < 0.01
