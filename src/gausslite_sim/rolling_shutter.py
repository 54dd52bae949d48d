"""Render a view through a rolling shutter: bands of rows, each from the camera's pose at its exposure time."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.trajectory import Twist
from gausslite_sim.scene import HomeScene
from gausslite_sim.view import View, render_view

_BAND_ROWS = 4


def render_rolling_view(
    scene: HomeScene,
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
    twist: Twist,
    readout_s: float,
    mirror: float = 1.0,
) -> View:
    """Return one view whose rows are exposed from -readout_s / 2 (top) to readout_s / 2 (bottom) around the pose.

    Each band of 4 rows has the time of its centre. twist: the camera's velocity; mirror: as in `render_view`.
    """
    bands = []
    for first in range(0, camera.height_px, _BAND_ROWS):
        rows = min(_BAND_ROWS, camera.height_px - first)
        time_s = readout_s * ((first + 0.5 * rows) / camera.height_px - 0.5)
        band = replace(camera, cy_px=camera.cy_px - first, height_px=rows)
        bands.append(render_view(scene, band, T_world_camera @ twist.motion(time_s), mirror))
    return View(*(np.concatenate([getattr(band, field.name) for band in bands]) for field in fields(View)))
