"""A box that moves through a simulated home: it stands for a person, and no map should keep it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.view import View

_SIZE_M = np.array([0.4, 0.4, 1.0])
_AHEAD_M = 1.8
_REACH_M = 0.9
_FRAMES_PER_TURN = 50
_RGB = np.array([200.0, 90.0, 40.0], np.float32)
_SHADES = np.array([0.7, 0.85, 1.0], np.float32)


def box_centre_m(poses: Float64[ndarray, "n 4 4"], frame: int) -> Float64[ndarray, "3"]:
    """Return the box's centre: it swings across the view of the trajectory's middle."""
    middle = poses[len(poses) // 2]
    swing_m = _REACH_M * np.sin(2 * np.pi * frame / _FRAMES_PER_TURN)
    centre_m: Float64[ndarray, "3"] = middle[:3, 3] + _AHEAD_M * middle[:3, 2] + swing_m * middle[:3, 0]
    return centre_m


def with_box(view: View, camera: RayCamera, centre_m: Float64[ndarray, "3"]) -> View:
    """Return the view with the box in front of what it hides. Its item and gloss are those of nothing."""
    pixels = camera.pixels()
    rays = camera.rays(pixels, *camera.centres(pixels))
    directions = np.where(np.abs(rays.directions) < 1e-9, 1e-9, rays.directions)
    near, far = (
        (centre_m + sign * np.sign(directions) * _SIZE_M / 2 - rays.origins_m) / directions for sign in (-1.0, 1.0)
    )
    entry, axis = near.max(axis=1), near.argmax(axis=1)
    depth_m = entry.astype(np.float32).reshape(view.depth_m.shape)
    is_hit = ((entry < far.min(axis=1)) & (entry > 0)).reshape(depth_m.shape)
    is_shown = is_hit & ((view.depth_m == 0) | (depth_m < view.depth_m))
    colours = (_RGB * _SHADES[axis][:, None]).reshape(view.rgb.shape)
    return replace(
        view,
        rgb=np.where(is_shown[..., None], colours, view.rgb),
        depth_m=np.where(is_shown, depth_m, view.depth_m),
        item=np.where(is_shown, -1, view.item),
        gloss=np.where(is_shown, np.float32(0), view.gloss),
    )
