"""The page's camera starts behind the robot, or beside a map without a trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
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
