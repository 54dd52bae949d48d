"""Render a home: exact depth, exact instances, and colour anti-aliased at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
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


def render_view(scene: HomeScene, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], mirror: float = 1.0) -> View:
    """Return one view; depth is that of the ray through the pixel's centre.

    mirror: scale of reflections; 0 renders all surfaces matt.
    """
    shape = (camera.height_px, camera.width_px)
    columns, rows = _pixel_centres(camera)
    directions = _directions(columns, rows, camera, T_world_camera)
    hits = _cast_from(scene, directions, T_world_camera)
    depth_m = _depth(hits)
    rgb, facing = _shade(scene, hits, directions, camera, T_world_camera, mirror)
    item = np.where(hits.triangle == NO_HIT, NO_HIT, scene.triangles.item[hits.triangle])
    texture = scene.triangles.texture[hits.triangle]
    edge = np.flatnonzero(_edges(*(image.reshape(shape) for image in (item, texture, depth_m, facing))))
    if len(edge):
        fine_columns = (columns[edge, None] + _SUBSAMPLES[:, 0]).ravel()
        fine_rows = (rows[edge, None] + _SUBSAMPLES[:, 1]).ravel()
        fine = _directions(fine_columns, fine_rows, camera, T_world_camera)
        fine_rgb, _ = _shade(scene, _cast_from(scene, fine, T_world_camera), fine, camera, T_world_camera, mirror)
        rgb[edge] = fine_rgb.reshape(-1, len(_SUBSAMPLES), 3).mean(axis=1)
    gloss = mirror * np.where(hits.triangle == NO_HIT, np.float32(0), scene.triangles.gloss[hits.triangle])
    return View(rgb.reshape(*shape, 3), *(image.reshape(shape) for image in (depth_m, item, facing, gloss)))


def render_instances(
    scene: HomeScene, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]
) -> Int64[ndarray, "h w"]:
    """Return the index of the object in each pixel, NO_HIT without one."""
    directions = _directions(*_pixel_centres(camera), camera, T_world_camera)
    triangle = _cast_from(scene, directions, T_world_camera).triangle
    item: Int64[ndarray, " n"] = np.where(triangle == NO_HIT, NO_HIT, scene.triangles.item[triangle])
    return item.reshape(camera.height_px, camera.width_px)


def _pixel_centres(camera: Camera) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
    rows, columns = np.divmod(np.arange(camera.height_px * camera.width_px), camera.width_px)
    return columns.astype(np.float32) + np.float32(0.5), rows.astype(np.float32) + np.float32(0.5)


def _directions(
    columns: Float32[ndarray, " n"],
    rows: Float32[ndarray, " n"],
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
) -> Float32[ndarray, "n 3"]:
    """Return ray directions with length 1 along the optical axis, so that the ray parameter is the depth."""
    x = (columns - np.float32(camera.cx_px)) / np.float32(camera.fx_px)
    y = (rows - np.float32(camera.cy_px)) / np.float32(camera.fy_px)
    R = T_world_camera[:3, :3].astype(np.float32)
    # no matrix product: its rounding may depend on the number of rays and cores
    directions: Float32[ndarray, "n 3"] = np.stack([R[k, 0] * x + R[k, 1] * y + R[k, 2] for k in range(3)], axis=1)
    return directions


def _cast_from(scene: HomeScene, directions: Float32[ndarray, "n 3"], T_world_camera: Float64[ndarray, "4 4"]) -> Hits:
    eye = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), directions.shape)
    return scene.cast(np.ascontiguousarray(eye), directions)


def _depth(hits: Hits) -> Float32[ndarray, " n"]:
    depth_m: Float32[ndarray, " n"] = np.where(hits.triangle == NO_HIT, np.float32(0), hits.distance)
    return depth_m


def _shade(
    scene: HomeScene,
    hits: Hits,
    directions: Float32[ndarray, "n 3"],
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
    mirror: float,
) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, " n"]]:
    """Return the shaded colour of each hit, black without a hit, and |cos| of the incidence."""
    facing = facing_of(scene, hits, directions)
    # geometric mean of the pixel's footprints across and along the slope
    pixel_m = hits.distance / np.float32(camera.fx_px) / np.sqrt(np.maximum(facing, 0.05))
    rgb = diffuse_colour(scene, hits, pixel_m)
    if mirror > 0:
        add_reflections(scene, rgb, hits, directions, T_world_camera[:3, 3].astype(np.float32), mirror)
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
