"""The page's camera starts at the task's region, behind the robot, or beside a map without a trajectory."""

from dataclasses import replace

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox
from gausslite_view.contents import ViewContents, start_view

CAMERA = Camera(300.0, 300.0, 320.0, 240.0, 640, 480)
MAP = ViewContents.of_one_agent(plain_gaussians(np.random.default_rng(1).normal(size=(200, 3)) + 5.0))


def test_a_map_alone_is_seen_from_beside_with_z_up():
    view = start_view(MAP)
    assert view.up == (0.0, 0.0, 1.0)
    assert np.allclose(view.look_at_m, 5.0, atol=0.6)
    offset_m = np.subtract(view.position_m, view.look_at_m)
    assert (offset_m * [1, -1, 1] > 0.5).all()


def test_a_map_of_one_gaussian_is_seen_from_a_distance():
    view = start_view(ViewContents.of_one_agent(plain_gaussians([[1.0, 2.0, 3.0]])))
    assert np.linalg.norm(np.subtract(view.position_m, view.look_at_m)) > 0.05


def test_the_keyframes_of_a_team_give_the_up_direction():
    # a camera that looks along z with y down: up is -y
    view = start_view(replace(MAP, keyframes=[KeyframeView(0, 0, CAMERA, np.eye(4), 0)]))
    assert view.up == (0.0, -1.0, 0.0)
    assert np.subtract(view.position_m, view.look_at_m)[1] < -0.5


def test_the_view_of_a_robot_starts_behind_its_first_keyframe():
    robot = replace(MAP, times_ns=np.zeros(1, np.int64), T_world_camera=np.eye(4)[None])
    view = start_view(robot)
    assert np.allclose(view.position_m, [0.0, -0.3, -0.6])
    assert view.look_at_m[2] > 4.0
    assert view.up == (0.0, -1.0, 0.0)


def near_region(targets=()):
    """Return a map 8 m wide with a region of 0.2 m around (0, 0, 5), and two cameras, the second one nearer to it."""
    rng = np.random.default_rng(2)
    region_m = rng.uniform(-0.1, 0.1, (50, 3)) + np.array((0, 0, 5))
    means_m = np.concatenate([rng.uniform(-4, 4, (400, 3)), region_m])
    gaussians = plain_gaussians(means_m, active=np.arange(450) >= 400)
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, 3] = (0.0, 0.0, 3.0)
    keyframes = [KeyframeView(index, index, CAMERA, pose, 0) for index, pose in enumerate(poses)]
    return replace(ViewContents.of_one_agent(gaussians), keyframes=keyframes, objects=tuple(targets))


def test_the_view_looks_at_the_region_from_where_a_camera_saw_it():
    view = start_view(near_region())
    assert np.allclose(view.look_at_m, [0, 0, 5], atol=0.1)
    # on the line to the second camera, nearer than it
    assert np.allclose(view.position_m[:2], 0.0, atol=0.1)
    assert 3.0 < view.position_m[2] < 4.5


def test_of_several_targets_the_view_looks_at_the_one_with_the_regions_gaussians():
    def mug(number, centre_m):
        extent_m = AxisAlignedBox(tuple(np.subtract(centre_m, 0.15)), tuple(np.add(centre_m, 0.15)))
        return ObjectLandmark(f"mug-{number}", "mug", ObjectRole.TARGET, tuple(centre_m), extent_m, 0.9, 0, 1)

    view = start_view(near_region([mug(1, (3.0, 0.0, 0.0)), mug(2, (0.0, 0.0, 5.0))]))
    assert np.allclose(view.look_at_m, [0, 0, 5], atol=0.01)


def test_a_region_that_no_camera_saw_is_not_looked_at():
    contents = near_region()
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    view = start_view(replace(contents, keyframes=[KeyframeView(0, 0, CAMERA, behind, 0)]))
    assert not np.allclose(view.look_at_m, [0, 0, 5], atol=1.0)
