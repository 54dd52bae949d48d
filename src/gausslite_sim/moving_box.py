"""A box that moves through a simulated home: it stands for a person, and no map should keep it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite_sim.ray_camera import RayCamera, Rays
from gausslite_sim.view import PIXEL_RAYS_PX, View

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
    shape, pixels = camera.shape, camera.pixels()
    columns, rows = camera.centres(pixels)
    depth_m, face = _faces(camera.rays(pixels, columns, rows), centre_m, view.depth_m.ravel())
    image, window = face.astype(np.uint8).reshape(shape), np.ones((3, 3), np.uint8)
    edge = np.flatnonzero(cv2.dilate(image, window) != cv2.erode(image, window))
    colours = np.concatenate([np.zeros((1, 3), np.float32), _RGB * _SHADES[:, None]])
    rgb = np.where(face[:, None] > 0, colours[face], view.rgb.reshape(-1, 3))
    behind, behind_m, rgb[edge] = view.rgb.reshape(-1, 3)[edge], view.depth_m.ravel()[edge], 0
    for right, below in PIXEL_RAYS_PX:
        _, faces = _faces(camera.rays(edge, columns[edge] + right, rows[edge] + below), centre_m, behind_m)
        rgb[edge] += np.where(faces[:, None] > 0, colours[faces], behind) / len(PIXEL_RAYS_PX)
    is_shown = image > 0
    return replace(
        view,
        rgb=rgb.reshape(view.rgb.shape),
        depth_m=np.where(is_shown, depth_m.reshape(shape), view.depth_m),
        item=np.where(is_shown, -1, view.item),
        gloss=np.where(is_shown, np.float32(0), view.gloss),
    )


def _faces(
    rays: Rays, centre_m: Float64[ndarray, "3"], behind_m: Float32[ndarray, " n"]
) -> tuple[Float32[ndarray, " n"], Int64[ndarray, " n"]]:
    """Return the depth of the box along each ray, and 1 + the axis of the face that it shows, 0 for none."""
    directions = np.where(np.abs(rays.directions) < 1e-9, 1e-9, rays.directions)
    near, far = (
        (centre_m + sign * np.sign(directions) * _SIZE_M / 2 - rays.origins_m) / directions for sign in (-1.0, 1.0)
    )
    depth_m = near.max(axis=1).astype(np.float32)
    is_hit = (depth_m < far.min(axis=1)) & (depth_m > 0) & ((behind_m == 0) | (depth_m < behind_m))
    return depth_m, np.where(is_hit, near.argmax(axis=1) + 1, 0)
