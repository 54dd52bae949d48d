"""Procedural room for rasterizer benchmarks, ray-traced analytically from textured boxes.

Twelve cameras on a ring look at a table and provide the seeds. A camera between two of them is the view that is timed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera, lift
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import inverse, transform_points
from gausslite.render.rasterizer import LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, RGB, ROW_WIDTH

SEED_VIEWS = 12
_SEED_SIZE = (640, 480)
_FOCAL_PER_WIDTH = 0.82
_NEIGHBOURS = 5
_SCALE_PER_SPACING = 0.6
_SCALE_BOUNDS_M = (1e-4, 0.2)

_ROOM = ((-2.4, -2.1, 0.0), (2.4, 2.1, 2.6))
_ROOM_COLOUR = (0.74, 0.70, 0.63)
_BOXES = (
    ((-0.75, -0.45, 0.68), (0.75, 0.45, 0.73), (0.62, 0.43, 0.27)),
    ((-0.71, -0.41, 0.00), (-0.65, -0.35, 0.68), (0.48, 0.34, 0.22)),
    ((0.65, -0.41, 0.00), (0.71, -0.35, 0.68), (0.48, 0.34, 0.22)),
    ((-0.71, 0.35, 0.00), (-0.65, 0.41, 0.68), (0.48, 0.34, 0.22)),
    ((0.65, 0.35, 0.00), (0.71, 0.41, 0.68), (0.48, 0.34, 0.22)),
    ((-0.55, -0.25, 0.73), (-0.30, -0.05, 0.97), (0.78, 0.28, 0.22)),
    ((0.20, 0.08, 0.73), (0.55, 0.30, 0.80), (0.24, 0.48, 0.76)),
    ((-2.40, 1.20, 0.00), (-1.60, 2.10, 1.20), (0.47, 0.58, 0.42)),
    ((1.40, -2.10, 0.00), (2.30, -1.65, 1.75), (0.60, 0.51, 0.36)),
    ((1.55, 1.05, 0.00), (2.20, 1.70, 0.48), (0.72, 0.68, 0.34)),
)


@dataclass(frozen=True, slots=True, eq=False)
class BenchView:
    """An image of the room with its camera pose."""

    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    camera: Camera
    T_camera_world: Float64[ndarray, "4 4"]


def held_out_view(width_px: int, height_px: int) -> BenchView:
    """Return the view to time, between two cameras of the ring."""
    camera = _camera(width_px, height_px)
    pixels_px = np.stack(np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5), axis=-1).reshape(-1, 2)
    T_world_camera = _ring_pose(2.5)
    rgb, depth_m = _trace(pixels_px, camera, T_world_camera)
    image = np.round(rgb * 255.0).astype(np.uint8).reshape(height_px, width_px, 3)
    return BenchView(image, depth_m.astype(np.float32).reshape(height_px, width_px), camera, inverse(T_world_camera))


def seed_rows(count: int, opacity: float = 0.5) -> Float32[ndarray, "n 16"]:
    """Return rows of isotropic splats on the surfaces that the ring sees; scales follow the neighbours' distances.

    Pixels are sampled at random from twelve images of 640x480, in the order of the images. Raises InvalidInputError
    for fewer splats than views.
    """
    if count < SEED_VIEWS:
        raise InvalidInputError(f"gaussians: expected at least {SEED_VIEWS}, one per view, got {count}")
    rng = np.random.default_rng(0)
    camera = _camera(*_SEED_SIZE)
    points, colours = [], []
    for view, n in enumerate(np.diff(np.linspace(0, count, SEED_VIEWS + 1).astype(int))):
        # one pixel in each of n equal parts of the image, so that memory order follows the image rows
        flat = ((np.arange(n) + rng.random(n)) * (camera.width_px * camera.height_px / n)).astype(np.int64)
        pixels_px = np.stack([flat % camera.width_px, flat // camera.width_px], axis=1) + 0.5
        T_world_camera = _ring_pose(float(view))
        rgb, depth_m = _trace(pixels_px, camera, T_world_camera)
        points.append(transform_points(T_world_camera, lift(pixels_px, depth_m, camera)))
        colours.append(rgb)
    means_m = np.concatenate(points).astype(np.float32)
    rows = np.zeros((count, ROW_WIDTH), np.float32)
    rows[:, MEAN] = means_m
    rows[:, LOG_SCALE] = np.log(np.clip(_SCALE_PER_SPACING * _spacing_m(means_m), *_SCALE_BOUNDS_M))[:, None]
    rows[:, QUAT.start] = 1.0
    rows[:, OPACITY_LOGIT] = np.log(opacity / (1.0 - opacity))
    rows[:, RGB] = np.concatenate(colours)
    return rows


def _spacing_m(points: Float32[ndarray, "n 3"]) -> Float32[ndarray, " n"]:
    """Return the median distance of each point to its five nearest neighbours."""
    exact_tree = cv2.flann.Index(points, {"algorithm": 4, "leaf_max_size": 10})
    _, squared = exact_tree.knnSearch(points, min(_NEIGHBOURS + 1, len(points)), params={"checks": -1})
    spacing: Float32[ndarray, " n"] = np.sqrt(np.median(squared[:, 1:], axis=1)).astype(np.float32)
    return spacing


def _camera(width_px: int, height_px: int) -> Camera:
    return Camera.centred(_FOCAL_PER_WIDTH * width_px, width_px, height_px)


def _ring_pose(position: float) -> Float64[ndarray, "4 4"]:
    """Return T_world_camera at a position from 0 to 12 on a wavy ring round the table, looking at the table."""
    angle = 2.0 * np.pi * position / SEED_VIEWS
    eye = np.array([1.6 * np.cos(angle), 1.3 * np.sin(angle), 1.45 + 0.2 * np.sin(3.0 * angle)])
    forward = np.array([0.2 * np.sin(2.0 * angle), 0.2 * np.cos(angle), 0.85]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T_world_camera[:3, 3] = eye
    return T_world_camera


def _trace(
    pixels_px: Float64[ndarray, "n 2"], camera: Camera, T_world_camera: Float64[ndarray, "4 4"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, " n"]]:
    """Return colours in [0, 1] and depths in metres at these image coordinates."""
    # rays have length 1 along the optical axis, so that the ray parameter is the depth
    rays = lift(pixels_px, np.ones(len(pixels_px)), camera) @ T_world_camera[:3, :3].T
    eye = T_world_camera[:3, 3]
    depth_m, shape = _first_hit(eye, rays)
    return _texture(eye + rays * depth_m[:, None], shape), depth_m


def _first_hit(
    eye: Float64[ndarray, "3"], rays: Float64[ndarray, "n 3"]
) -> tuple[Float64[ndarray, " n"], Int64[ndarray, " n"]]:
    """Return each ray's first hit: the ray parameter and the shape (0 the room, then boxes)."""
    with np.errstate(divide="ignore"):
        inverse_rays = 1.0 / rays
    _, nearest = _through_box(eye, inverse_rays, *_ROOM)
    shape = np.zeros(len(rays), np.int64)
    for i, (low, high, _) in enumerate(_BOXES):
        enters, leaves = _through_box(eye, inverse_rays, low, high)
        hit = (enters < leaves) & (enters > 0.0) & (enters < nearest)
        nearest[hit], shape[hit] = enters[hit], 1 + i
    return nearest, shape


def _through_box(
    eye: Float64[ndarray, "3"],
    inverse_rays: Float64[ndarray, "n 3"],
    low: tuple[float, float, float],
    high: tuple[float, float, float],
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the ray parameters where each ray enters and leaves the box (slab method)."""
    a, b = (np.array(low) - eye) * inverse_rays, (np.array(high) - eye) * inverse_rays
    return np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)


def _texture(p_world: Float64[ndarray, "n 3"], shape: Int64[ndarray, " n"]) -> Float64[ndarray, "n 3"]:
    """Return each shape's colour modulated by waves of 2 to 30 per metre and by coarse squares."""
    colours = np.array([_ROOM_COLOUR, *(c for _, _, c in _BOXES)])
    rng = np.random.default_rng(1)
    waves = np.zeros(len(p_world))
    for per_metre, strength in ((2.0, 0.16), (5.0, 0.13), (12.0, 0.10), (30.0, 0.07)):
        waves += strength * np.sin(2.0 * np.pi * per_metre * (p_world @ rng.normal(size=3)))
    # offset from the walls, where rounding would decide the result of floor
    squares = np.floor(4.0 * p_world + 0.37).sum(axis=1) % 2.0
    textured: Float64[ndarray, "n 3"] = np.clip(colours[shape] * (0.7 + waves + 0.2 * squares)[:, None], 0.0, 1.0)
    return textured
