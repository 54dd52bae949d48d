"""Rolling shutter, motion blur and lens of a simulated camera are exact: each row, sample and ray has its own pose."""

import functools

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens
from gausslite_sim.home_catalogue import plan_home
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.ray_camera import RayCamera, undistorted
from gausslite_sim.recorded_view import RecordingCamera, render_recorded_view
from gausslite_sim.scene import HomeScene
from gausslite_sim.view import render_view

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

CAMERA = Camera(68.0, 68.0, 40.0, 30.0, 80, 60)
FRAMES, FRAME, INTERVAL_S = 60, 20, 0.05


@functools.cache
def home() -> HomePlan:
    return plan_home(0, 0)


@pytest.fixture(scope="module")
def scene() -> HomeScene:
    return HomeScene(home())


def poses_at(seconds: np.ndarray) -> np.ndarray:
    return home().trajectories[1](FRAMES, FRAME + seconds / INTERVAL_S)


@pytest.mark.slow
def test_each_row_shows_the_scene_from_the_pose_at_its_time(scene: HomeScene) -> None:
    camera = RecordingCamera(CAMERA, readout_s=0.03)
    recorded = render_recorded_view(scene, camera, poses_at)
    for row in (0, 30, 59):
        time_s = camera.row_times_s()[row]
        at_its_time = render_view(scene, RayCamera(CAMERA, poses_at(np.array([time_s]))[0]))
        np.testing.assert_allclose(recorded.depth_m[row], at_its_time.depth_m[row], rtol=1e-5)
        assert (recorded.item[row] == at_its_time.item[row]).all()
    assert camera.row_times_s()[0] == pytest.approx(-camera.row_times_s()[-1])


def test_the_middle_row_of_a_frame_has_the_trajectorys_pose() -> None:
    spec = "sim:home?frames=60&size=80x60&noise=0&exposure=0&speed=60"
    still, rolling = (open_source(f"{spec}{option}").frame(20) for option in ("", "&shutter=30ms&blur=10ms"))
    np.testing.assert_array_equal(still.T_world_camera, rolling.T_world_camera)
    middle = np.abs(still.depth_m[30] - rolling.depth_m[30])
    assert np.median(middle) < 0.2 * np.median(np.abs(still.depth_m[0] - rolling.depth_m[0]))


def test_blur_is_the_mean_over_the_exposure_and_depth_that_of_its_middle(scene: HomeScene) -> None:
    blurred = render_recorded_view(scene, RecordingCamera(CAMERA, exposure_s=0.02), poses_at)
    times_s = 0.02 * ((np.arange(32) + 0.5) / 32 - 0.5)
    views = [render_view(scene, RayCamera(CAMERA, pose)) for pose in poses_at(times_s)]
    expected = np.mean([view.rgb for view in views], axis=0)
    sharp = render_view(scene, RayCamera(CAMERA, poses_at(np.zeros(1))[0]))
    np.testing.assert_allclose(blurred.depth_m, sharp.depth_m, rtol=1e-5)
    assert np.abs(blurred.rgb - expected).mean() < 0.15 * np.abs(sharp.rgb - expected).mean()


@pytest.mark.parametrize("text", ["radtan:-0.2,0.05,0.002,-0.001", "fisheye:0.05,0.01,0,0"])
def test_a_lens_moves_what_the_pinhole_shows_by_its_distortion(scene: HomeScene, text: str) -> None:
    lens, T_world_camera = Lens.parse(text), poses_at(np.zeros(1))[0]
    distorted = render_view(scene, RayCamera(CAMERA, T_world_camera, lens))
    rows, columns = np.array([5, 30, 50, 55]), np.array([4, 41, 70, 12])
    x, y = undistorted(lens, (columns + 0.5 - CAMERA.cx_px) / CAMERA.fx_px, (rows + 0.5 - CAMERA.cy_px) / CAMERA.fy_px)
    directions = (np.stack([x, y, np.ones_like(x)], axis=1) @ T_world_camera[:3, :3].T).astype(np.float32)
    eyes = np.repeat(T_world_camera[None, :3, 3], len(x), axis=0).astype(np.float32)
    np.testing.assert_allclose(distorted.depth_m[rows, columns], scene.cast(eyes, directions).distance, rtol=1e-3)


def test_all_options_work_together() -> None:
    spec = "sim:home?frames=40&size=80x60&noise=0&exposure=0&speed=60&shutter=30ms&blur=10ms&lens=radtan:-0.2,0,0,0"
    source = open_source(spec)
    frame = source.frame(7)
    assert source.lens is None
    assert frame.has_depth
    assert frame.rgb.tobytes() == open_source(spec).frame(7).rgb.tobytes()


@pytest.mark.parametrize(
    "text", ["radtan:-0.2,0.05,0.002,-0.001", "radtan:0.2624,-0.9531,-0.0054,0.0026,1.1633", "fisheye:0.1,0.02,0,0"]
)
def test_undistorted_points_are_distorted_back_to_where_they_were(text: str) -> None:
    lens, points = Lens.parse(text), np.random.default_rng(0).uniform(-0.56, 0.56, (2, 200))
    np.testing.assert_allclose(lens.distort(*undistorted(lens, *points)), points, atol=1e-6)


def test_a_slope_that_no_ray_meets_is_named() -> None:
    with pytest.raises(InvalidInputError, match="inverted"):
        undistorted(Lens.parse("radtan:-1,0,0,0"), np.array([0.1, 2.0]), np.zeros(2))
