"""Free cells of an exported room: seen floor and air are free, walls are occupied, what lies behind them is unknown."""

import dataclasses
import re
from pathlib import Path

import cv2
import numpy as np
import pyoctomap
import pytest
import yaml

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, transform_of, transform_points
from gausslite.mapping.free_space import DepthView
from gausslite.plugins import Group, load
from gausslite.render.map_viewer import view_map
from gausslite_export.format import ExportSettings, Format, MapContent
from gausslite_export.formats import upright_motion
from gausslite_export.occupancy import FREE, OCCUPIED, OccupancySettings, occupied_voxels
from gausslite_export.surface_votes import count_votes

VOXEL_M, HALF_M, WALL_M, EYE_M = 0.1, 2.0, 1.5, 0.75
SETTINGS = OccupancySettings(voxel_m=VOXEL_M)
CAMERA = Camera.centred(80.0, 160, 120)


def room() -> Gaussians:
    """Return four walls of a square room, and a post outside of them."""
    along, up = (v.ravel() for v in np.meshgrid(np.arange(-HALF_M, HALF_M, 0.05), np.arange(0.0, WALL_M, 0.05)))
    side = np.full(len(along), HALF_M)
    walls = [np.stack(axes, 1) for s in (-1, 1) for axes in ((s * side, along, up), (along, s * side, up))]
    post = np.stack([np.full(30, 3.5), np.zeros(30), np.arange(30) * 0.05], axis=1)
    means = np.concatenate([*walls, post]).astype(np.float32) + np.float32(0.02)
    n = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    scales, colours = np.full((n, 3), 0.025, np.float32), np.full((n, 3), 0.5, np.float32)
    flags = np.ones(n, np.bool_), np.ones(n, np.uint32), np.zeros(n, np.int16)
    return Gaussians(means, quats, scales, np.full(n, 0.95, np.float32), colours, *flags)


def turned(angle_rad: float) -> np.ndarray:
    """Return the pose of a level camera in the middle of the room."""
    forward = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    T[:3, 3] = 0.03, 0.03, EYE_M
    return T


VIEWS = [KeyframeView(i, i, CAMERA, turned(i * np.pi / 4), 0) for i in range(8)]


def export(path: Path, name: str, content: MapContent) -> Path:
    chosen: Format = load(Group.EXPORTERS, name)
    out = path / f"map{chosen.suffix}"
    chosen.write(out, content, ExportSettings(voxel_m=VOXEL_M))
    return out


def grid(file: Path) -> tuple[np.ndarray, list[float]]:
    """Return the cells, indexed by x and y, and the origin."""
    image = cv2.imread(str(file.with_suffix(".pgm")), cv2.IMREAD_UNCHANGED)
    return image[::-1].T, yaml.safe_load(file.read_text())["origin"]


def test_a_rooms_inside_is_free_its_walls_are_occupied_and_behind_them_is_unknown(tmp_path):
    gaussians = room()
    cells, origin = grid(export(tmp_path, "nav2", MapContent(gaussians, gaussians, views=VIEWS)))
    at = lambda x, y: cells[int((x - origin[0]) / VOXEL_M), int((y - origin[1]) / VOXEL_M)]  # noqa: E731
    assert all(at(x, y) == 254 for x in (-1.45, 1.15, 1.45) for y in (-1.45, 1.15, 1.45))
    assert all(at(*p) == 0 for p in ((2.03, 0.05), (-1.97, 0.05), (0.05, 2.03), (0.05, -1.97)))
    assert at(0.05, 0.05) == 205  # no camera sees the floor below it
    assert cells.shape[0] <= 42  # nor the post behind the wall


def test_needles_of_gaussians_are_no_obstacles_and_measured_depth_comes_before_that_of_the_map(tmp_path):
    walls = room()
    scales_m = walls.scales_m.copy()
    scales_m[::40] = 0.5, 0.01, 0.01  # through the walls, and along them
    needles = dataclasses.replace(walls, scales_m=scales_m)
    render = view_map(walls).render
    depths_m = {view.index: render(CAMERA, view.T_world_camera).expected_depth_m() for view in VIEWS}
    content = MapContent(needles, needles, views=VIEWS, depths_m=depths_m)
    cells, origin = grid(export(tmp_path, "nav2", content))
    plain, plain_origin = grid(export(tmp_path, "nav2", MapContent(walls, walls, views=VIEWS)))
    assert origin == plain_origin
    assert (cells == plain).all()


def test_distances_to_obstacles_have_the_pose_of_their_grid(tmp_path, capsys):
    gaussians = room()
    T_map_upright = transform_of(np.array([1.0, 2.0, 3.0, 0.0, np.pi / 2, 0.0]))
    content = MapContent(gaussians, gaussians, views=VIEWS, T_upright_map=inverse(T_map_upright))
    found = np.load(export(tmp_path, "esdf", content))
    floor = re.search(r"the floor is where (\S+) x = (\S+) m in .* p_map = T_map_grid p_grid", capsys.readouterr().err)
    row, column = (int((1.25 - low) / VOXEL_M) for low in found["origin_m"])
    assert found["cells"][row, column] == FREE
    assert found["distance_m"][row, column] == pytest.approx(0.8, abs=0.11)
    assert found["distance_m"][found["cells"] == OCCUPIED].max() == 0
    in_map_m = transform_points(found["T_map_grid"], np.array([1.25, 1.25, 0.0]))
    np.testing.assert_allclose(transform_points(inverse(T_map_upright), in_map_m), (1.25, 1.25, 0.0), atol=0.11)
    assert float(floor[1]) * in_map_m[0] == pytest.approx(float(floor[2]), abs=2e-3)
    export(tmp_path, "nav2", MapContent(gaussians, gaussians, views=VIEWS))
    said = capsys.readouterr().err
    assert "the floor is where 1.0 z = " in said
    assert "may be none" not in said


def test_a_grid_of_a_world_whose_up_is_not_stated_is_doubted(tmp_path, capsys):
    T_camera_world = inverse(VIEWS[0].T_world_camera)
    gaussians = move_gaussians(room(), T_camera_world)
    views = [dataclasses.replace(view, T_world_camera=T_camera_world @ view.T_world_camera) for view in VIEWS]
    export(tmp_path, "nav2", MapContent(gaussians, gaussians, views=views))
    assert "its floor may be none: images show up as 0,-1,0, not as 0,0,1" in capsys.readouterr().err


def test_a_thin_surface_stays_where_most_images_see_past_it_and_one_error_is_none():
    far = np.full((120, 160), 3.0, np.float32)
    near = far.copy()
    near[50:70, 79:81] = 1.0
    votes = count_votes([DepthView.of(image, CAMERA, np.eye(4)) for image in (near, near, far, far, far)], VOXEL_M)
    assert (votes.surface()[:, 2] == 10).any()
    once = count_votes([DepthView.of(image, CAMERA, np.eye(4)) for image in (near, far, far)], VOXEL_M)
    assert not (once.surface()[:, 2] == 10).any()


def test_octomap_has_free_voxels_and_none_of_them_holds_an_opaque_gaussian(tmp_path):
    gaussians = room()
    # the region is one wall: voxels of the others are not free either
    region = dataclasses.replace(gaussians, active=np.abs(gaussians.means_m[:, 0]) < 1.9)
    content = MapContent(region, region.take(region.active), views=VIEWS)
    tree = pyoctomap.OcTree(str(export(tmp_path, "octomap", content)).encode())
    air = tree.search([0.55, 0.05, EYE_M])
    assert air is not None
    assert air.getLogOdds() < 0
    for centre_m in (occupied_voxels(region, SETTINGS) + 0.5) * VOXEL_M:
        node = tree.search(centre_m)
        assert node is None or node.getLogOdds() > 0


def test_a_floor_whose_ellipsoids_reach_below_and_above_it_is_free(tmp_path):
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-HALF_M, HALF_M, 0.05), np.arange(-HALF_M, HALF_M, 0.05)))
    walls = room()
    floor = walls.take(np.arange(len(x)) % len(walls))
    noise_m = np.random.default_rng(0).normal(0, 0.005, len(x))
    floor = dataclasses.replace(
        floor,
        means_m=np.stack([x, y, noise_m], axis=1).astype(np.float32),
        scales_m=np.full((len(x), 3), 0.05, np.float32),
    )
    columns = {f.name: np.concatenate([getattr(m, f.name) for m in (walls, floor)]) for f in dataclasses.fields(walls)}
    gaussians = Gaussians(**columns)
    cells, origin = grid(export(tmp_path, "nav2", MapContent(gaussians, gaussians)))
    inside = slice(int((-1.7 - origin[0]) / VOXEL_M), int((1.7 - origin[0]) / VOXEL_M))
    assert (cells[inside, inside] == 254).mean() > 0.95


def test_a_grid_says_that_its_floor_may_be_none(tmp_path, capsys):
    # the same room with y as up: the cameras are level about z
    gaussians = room()
    T = upright_motion(np.array([0.0, 1.0, 0.0]))
    views = [dataclasses.replace(view, T_world_camera=T @ view.T_world_camera) for view in VIEWS]
    turned_room = move_gaussians(gaussians, T)
    for up, views_of, shown, expected in (
        ([0.0, 0.0, 1.0], VIEWS, gaussians, ""),
        ([0.0, 1.0, 0.0], views, turned_room, "images show up as 0,0,1, not as 0,1,0;"),
    ):
        turn = np.eye(4) if not expected else T
        content = MapContent(shown, shown, views=views_of, T_upright_map=turn, report={"up": up})
        export(tmp_path, "nav2", content)
        said = capsys.readouterr().err
        assert ("its floor may be none" in said) == bool(expected)
        assert expected in said


def test_a_floor_that_is_seen_from_below_is_doubted(tmp_path, capsys):
    gaussians, flip = room(), np.diag((1.0, -1.0, -1.0, 1.0))
    views = [dataclasses.replace(view, T_world_camera=flip @ view.T_world_camera) for view in VIEWS]
    axis = np.arange(-HALF_M, HALF_M, 0.05)
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    level = gaussians.take(np.arange(len(x)) % len(gaussians))
    level = dataclasses.replace(level, means_m=np.stack([x, y, np.zeros(len(x))], 1).astype(np.float32))
    flipped = move_gaussians(level, flip)
    for shown, seen_by, is_doubted in ((level, VIEWS, False), (flipped, views, True)):
        export(tmp_path, "nav2", MapContent(shown, shown, views=seen_by))
        assert ("more of it is free below" in capsys.readouterr().err) == is_doubted
