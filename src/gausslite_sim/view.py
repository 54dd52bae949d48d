"""Render a home: exact depth, exact instances, and colour anti-aliased at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite_sim.ray_camera import RayCamera, Rays
from gausslite_sim.scene import NO_HIT, Hits, HomeScene
from gausslite_sim.shading import add_reflections, diffuse_colour, facing_of

_SUBSAMPLES = np.array([(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)], np.float32)
"""Offsets of the anti-aliasing rays from a pixel's centre, in pixels."""
_STEP = 0.03
"""Neighbours whose relative depth difference exceeds this lie on different surfaces."""
_CREASE = 0.1
"""Neighbours whose cosines of incidence differ by more than this lie on different faces."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Image of an ideal camera. rgb is 0 to 255.

    item: index into HomeScene.names, or NO_HIT. facing: |cos| of the angle of incidence. gloss: reflected share.
    """

    rgb: Float32[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    item: Int64[ndarray, "h w"]
    facing: Float32[ndarray, "h w"]
    gloss: Float32[ndarray, "h w"]


def render_view(scene: HomeScene, camera: RayCamera) -> View:
    """Return one view; depth is that of the ray through the pixel's centre, along the optical axis of its row."""
    shape = camera.shape
    pixels = camera.pixels()
    rays = camera.rays(pixels, *camera.centres(pixels))
    hits = scene.cast(rays.origins_m, rays.directions)
    depth_m = _depth(hits)
    rgb, facing = _shade(scene, hits, rays, camera)
    item = np.where(hits.triangle == NO_HIT, NO_HIT, scene.triangles.item[hits.triangle])
    texture = scene.triangles.texture[hits.triangle]
    edge = np.flatnonzero(_edges(*(image.reshape(shape) for image in (item, texture, depth_m, facing))))
    if len(edge):
        columns, rows = camera.centres(edge)
        fine_columns = (columns[:, None] + _SUBSAMPLES[:, 0]).ravel()
        fine_rows = (rows[:, None] + _SUBSAMPLES[:, 1]).ravel()
        fine = camera.rays(np.repeat(edge, len(_SUBSAMPLES)), fine_columns, fine_rows)
        fine_rgb, _ = _shade(scene, scene.cast(fine.origins_m, fine.directions), fine, camera)
        rgb[edge] = fine_rgb.reshape(-1, len(_SUBSAMPLES), 3).mean(axis=1)
    gloss = np.where(hits.triangle == NO_HIT, np.float32(0), scene.triangles.gloss[hits.triangle])
    return View(rgb.reshape(*shape, 3), *(image.reshape(shape) for image in (depth_m, item, facing, gloss)))


def render_instances(
    scene: HomeScene, camera: Camera, T_world_camera: Float64[ndarray, "4 4"] | Float64[ndarray, "h 4 4"]
) -> Int64[ndarray, "h w"]:
    """Return the index of the object in each pixel of a pinhole camera, NO_HIT without one.

    T_world_camera: one pose, or one for each row.
    """
    ray_camera = RayCamera(camera, T_world_camera)
    pixels = ray_camera.pixels()
    rays = ray_camera.rays(pixels, *ray_camera.centres(pixels))
    triangle = scene.cast(rays.origins_m, rays.directions).triangle
    item: Int64[ndarray, " n"] = np.where(triangle == NO_HIT, NO_HIT, scene.triangles.item[triangle])
    return item.reshape(ray_camera.shape)


def _depth(hits: Hits) -> Float32[ndarray, " n"]:
    return np.where(hits.triangle == NO_HIT, np.float32(0), hits.distance)


def _shade(
    scene: HomeScene, hits: Hits, rays: Rays, camera: RayCamera
) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, " n"]]:
    """Return the shaded colour of each hit, black without a hit, and |cos| of the incidence."""
    facing = facing_of(scene, hits, rays.directions)
    # geometric mean of the pixel's footprints across and along the slope
    pixel_m = camera.camera.length_m(1.0, hits.distance) / np.sqrt(np.maximum(facing, 0.05))
    rgb = diffuse_colour(scene, hits, pixel_m)
    add_reflections(scene, rgb, hits, rays.directions, rays.origins_m)
    return rgb, facing


def _edges(
    item: Int64[ndarray, "h w"],
    texture: Int64[ndarray, "h w"],
    depth_m: Float32[ndarray, "h w"],
    facing: Float32[ndarray, "h w"],
) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels next to another object, another surface or a crease."""
    edge = np.zeros(item.shape, np.bool_)
    for a, b in (((slice(None), slice(1, None)), (slice(None), slice(-1))), ((slice(1, None),), (slice(-1),))):
        differs = (item[a] != item[b]) | (texture[a] != texture[b])
        differs |= np.abs(depth_m[a] - depth_m[b]) > _STEP * depth_m[a]
        differs |= np.abs(facing[a] - facing[b]) > _CREASE
        edge[a] |= differs
        edge[b] |= differs
    return edge
