"""Rows and views for the tests of the native backend."""

import numpy as np

from gausslite.domain.camera import Camera
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import TrainingView

CAMERA = Camera(75.0, 74.0, 50.3, 39.7, 101, 83)


def random_rows(n: int = 9000, seed: int = 0) -> np.ndarray:
    """Return random rows; the default is more than one projection segment, so that threads share the work."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = rng.uniform((-2, -2, -0.5), (2, 2, 4), (n, 3))
    rows[:, 3:6] = np.log(rng.uniform(0.005, 0.1, (n, 3)))
    rows[:, 6:10] = rng.normal(size=(n, 4))
    rows[:, 10] = rng.normal(0.0, 2.0, n)
    rows[:, 11:14] = rng.random((n, 3))
    return rows


def view_of(rasterizer: CpuRasterizer, camera: Camera = CAMERA, masked: bool = False) -> TrainingView:
    rng = np.random.default_rng(7)
    size = (camera.height_px, camera.width_px)
    pixel_weights = np.zeros(size, np.float32)
    pixel_weights[size[0] // 3 :, : size[1] // 2] = 1.0
    rgb = rng.integers(0, 256, (*size, 3), np.uint8)
    return rasterizer.prepare_view(
        rgb, rng.uniform(0, 4, size).astype(np.float32), camera, pixel_weights if masked else None
    )
