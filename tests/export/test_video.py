"""A fly-through video: its length, its pictures, and the path between keyframes."""

import cv2
import numpy as np
import pytest

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import require_rigid
from gausslite.render.rasterizer import Rendering
from gausslite_export.video import smooth_path, write_video

CAMERA = Camera(50.0, 50.0, 32.0, 24.0, 65, 49)


def turned(angle_rad: float, x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, angle_rad, 0.0]))[0]
    pose[0, 3] = x_m
    return pose


def render(camera: Camera, T_world_camera: np.ndarray) -> Rendering:
    """Return a grey that follows the camera's x."""
    size = camera.height_px, camera.width_px
    grey = np.full((*size, 3), T_world_camera[0, 3], np.float32)
    return Rendering(grey, np.zeros(size, np.float32), np.ones(size, np.float32), None)


def test_a_video_follows_the_keyframes_in_the_order_of_their_times(tmp_path):
    views = [KeyframeView(i, 1000 - i, CAMERA, turned(0.0, 1.0 - i / 9), 5) for i in range(10)]
    write_video(tmp_path / "map.mp4", views, render, seconds=1.0)
    assert [each.name for each in tmp_path.iterdir()] == ["map.mp4"]
    video = cv2.VideoCapture(str(tmp_path / "map.mp4"))
    greys = []
    while (frame := video.read())[0]:
        assert frame[1].shape == (48, 64, 3)
        greys.append(float(frame[1].mean()))
    assert len(greys) == 30
    assert greys[0] < 40
    assert greys[-1] > 215
    assert (np.diff(greys) > -2).all()


def test_a_smooth_path_is_rigid_and_shakes_less():
    rng = np.random.default_rng(0)
    shaky = np.stack([turned(0.2 * i + rng.normal(0, 0.05), 0.1 * i) for i in range(12)])
    path = smooth_path(shaky, 120)
    for pose in path:
        require_rigid("path", pose)
    angles = np.unwrap(np.arctan2(path[:, 0, 2], path[:, 2, 2]))
    assert abs(angles[60] - 0.2 * 5.5) < 0.1
    assert np.abs(np.diff(angles, 2)).max() < 0.01


@pytest.mark.parametrize("count", [0, 1])
def test_a_map_without_a_path_is_refused(tmp_path, count):
    views = [KeyframeView(0, 0, CAMERA, np.eye(4), 5)] * count
    with pytest.raises(InvalidInputError, match="at least two keyframes"):
        write_video(tmp_path / "map.mp4", views, render, seconds=1.0)
    assert not list(tmp_path.iterdir())
