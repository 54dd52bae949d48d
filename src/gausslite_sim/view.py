"""Render a home: exact depth and instances of the pixels' centres, and the mean colour over each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite_sim.pixel_parts import PixelParts, parts_of, whole_pixels
from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.scene import NO_HIT, Hits, HomeScene
from gausslite_sim.shading import HEAD_ON, Surface, add_reflections, uv_step
from gausslite_sim.textures import SIDE_PX

_UV_TOLERANCE = 0.15
"""Greatest error of a predicted texture coordinate, as a share of the pixel's footprint."""
_LIGHT_TOLERANCE = 0.05
"""Greatest difference of the light in a pixel's centre and at its border, about 1 under a lamp."""
_REFLECTION_TOLERANCE = 12.0
"""Greatest difference of the reflections in two neighbouring pixels, of 255."""
_SPREAD = 32.0
"""Standard deviation of the first rays' colours, of 255, from which a pixel gets all rays."""
_TAPS = 6
"""Texture look-ups along the shorter side of a pixel without an edge."""
_PART_TAPS = 3
"""The same for a part of a pixel with an edge."""
_RAYS = 64
_ORDER = np.argsort(np.arange(_RAYS) % 2 == 0, kind="stable")
PIXEL_RAYS_PX = ((np.stack([_ORDER, 19 * _ORDER % _RAYS], axis=1) + 0.5) / _RAYS - 0.5).astype(np.float32)
"""Offsets of rays from the centre of a pixel with an edge: a lattice; the first half of them is a lattice too."""


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


def render_view(scene: HomeScene, camera: RayCamera, rays_px: Float32[ndarray, "k 2"] = PIXEL_RAYS_PX) -> View:
    """Return one view; depth is that of the ray through the pixel's centre, along the optical axis of its row.

    rays_px: a part of PIXEL_RAYS_PX, if the mean of views from nearby poses is wanted.
    """
    shape, parts = camera.shape, whole_pixels(scene, camera)
    hits, surface = parts.hits, Surface.of(scene, parts.hits, parts.rays.directions)
    steps = _steps(scene, camera, parts)
    rgb, matt = _colours(scene, parts, surface, steps, _TAPS)
    is_hit = hits.triangle != NO_HIT
    item = np.where(is_hit, scene.triangles.item[hits.triangle], NO_HIT)
    gloss = np.where(is_hit, scene.triangles.gloss[hits.triangle], np.float32(0))
    uneven = _edges(scene, camera, hits, surface, steps)
    uneven |= _steps_between((rgb - matt * (1 - HEAD_ON * gloss[:, None])).reshape(*shape, 3)).ravel()
    edge = np.flatnonzero(uneven)
    rgb[edge] = _ray_means(scene, camera, edge, rays_px)
    images = (np.where(is_hit, hits.distance, np.float32(0)), item, surface.facing, gloss)
    return View(rgb.reshape(*shape, 3), *(image.reshape(shape) for image in images))


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


def _steps(scene: HomeScene, camera: RayCamera, parts: PixelParts) -> Float32[ndarray, "2 n 2"]:
    """Return the change of the texture coordinates from pixel to pixel, to the right and down."""
    at, directions = parts, parts.rays.directions
    turns = (camera.rays(at.pixels, at.columns + 0.5, at.rows), camera.rays(at.pixels, at.columns, at.rows + 0.5))
    return np.stack([uv_step(scene, at.hits, directions, 2 * (t.directions - directions)) for t in turns])


def _colours(
    scene: HomeScene, parts: PixelParts, surface: Surface, steps: Float32[ndarray, "2 n 2"], taps: int
) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, "n 3"]]:
    """Return the mean colours over parts of pixels, with reflections and without."""
    sides, texture = steps * parts.sides[:, :, None], scene.triangles.texture[parts.hits.triangle]
    matt = scene.atlas.mean(texture, surface.uv, sides, taps) * surface.light
    rgb = matt.copy()
    add_reflections(scene, rgb, parts.hits, parts.rays.directions, parts.rays.origins_m)
    return rgb, matt


def _edges(
    scene: HomeScene, camera: RayCamera, hits: Hits, surface: Surface, steps: Float32[ndarray, "2 n 2"]
) -> Bool[ndarray, " n"]:
    """Return the pixels where another texture shows, or other coordinates or light than predicted.

    Their corners are looked at, and the middles of their upper and lower sides.
    """
    table, (height, width) = scene.triangles, camera.shape
    probes = 2 * width + 1
    probe_row, probe_column = np.divmod(np.arange((height + 1) * probes), probes)
    exposed = np.minimum(probe_row, height - 1) * width
    rays = camera.rays(exposed, probe_column.astype(np.float32) / 2, probe_row.astype(np.float32))
    probed = scene.cast(rays.origins_m, rays.directions)
    footprint = np.maximum(np.abs(steps).max(axis=(0, 2)), np.float32(1 / SIDE_PX))
    row, column = np.divmod(camera.pixels(), width)
    edge = np.zeros(len(row), np.bool_)
    for below, right in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)):
        at = (row + below) * probes + 2 * column + right
        # within one triangle the prediction holds
        other = np.flatnonzero(probed.triangle[at] != hits.triangle)
        at = at[other]
        found = Hits(probed.triangle[at], probed.barycentric[at], probed.distance[at])
        seen = Surface.of(scene, found, rays.directions[at])
        predicted = surface.uv[other] + (0.5 * right - 0.5) * steps[0][other] + (below - 0.5) * steps[1][other]
        error = seen.uv - predicted
        differs = np.abs(error - np.rint(error)).max(axis=1) > _UV_TOLERANCE * footprint[other]
        differs |= np.abs(seen.light - surface.light[other]).max(axis=1) > _LIGHT_TOLERANCE
        for values in (table.texture, table.item):
            differs |= values[found.triangle] != values[hits.triangle[other]]
        edge[other] |= differs
    return edge


def _steps_between(reflections: Float32[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    """Return the pixels next to one with another reflection."""
    edge = np.zeros(reflections.shape[:2], np.bool_)
    for a, b in (((slice(None), slice(1, None)), (slice(None), slice(-1))), ((slice(1, None),), (slice(-1),))):
        differs = np.abs(reflections[a] - reflections[b]).max(axis=2) > _REFLECTION_TOLERANCE
        edge[a] |= differs
        edge[b] |= differs
    return edge


def _ray_means(
    scene: HomeScene, camera: RayCamera, pixels: Int64[ndarray, " n"], rays_px: Float32[ndarray, "k 2"]
) -> Float32[ndarray, "n 3"]:
    """Return the mean colours of half of the rays in each pixel, or of all where the colours of the half differ."""
    half = max(1, len(rays_px) // 2)
    share = np.float32(half / len(rays_px))
    means, deviations = _mean_of_parts(scene, camera, pixels, rays_px[:half])
    uneven = np.flatnonzero(deviations > _SPREAD)
    if len(uneven) and share < 1:
        more, _ = _mean_of_parts(scene, camera, pixels[uneven], rays_px[half:])
        means[uneven] = share * means[uneven] + (1 - share) * more
    return means


def _mean_of_parts(
    scene: HomeScene, camera: RayCamera, pixels: Int64[ndarray, " n"], rays_px: Float32[ndarray, "k 2"]
) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, " n"]]:
    """Return the mean colours of rays in each pixel, and the largest standard deviation of a channel."""
    if not len(pixels):
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    parts, shares = parts_of(scene, camera, pixels, rays_px, 1 / _RAYS)
    surface = Surface.of(scene, parts.hits, parts.rays.directions)
    rgb, _ = _colours(scene, parts, surface, _steps(scene, camera, parts), _PART_TAPS)
    starts = np.flatnonzero(np.diff(parts.pixels, prepend=-1))
    sums = np.add.reduceat(np.concatenate([rgb, rgb * rgb], axis=1) * shares[:, None], starts, axis=0)
    means: Float32[ndarray, "n 3"] = sums[:, :3].copy()
    return means, np.sqrt(np.maximum(sums[:, 3:] - means * means, 0)).max(axis=1)
