"""Divide pixels into the parts in which one triangle shows, so that each is shaded once and not ray by ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite_sim.ray_camera import RayCamera, Rays
from gausslite_sim.scene import Hits, HomeScene

_CELLS_RIGHT, _CELLS_DOWN = 2, 4
"""Cells of a pixel on a glossy triangle, whose reflection may change within it."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelParts:
    """Parts of pixels: the flat index of the pixel, the mean ray and hit, width and height as shares of the pixel."""

    pixels: Int64[ndarray, " n"]
    columns: Float32[ndarray, " n"]
    rows: Float32[ndarray, " n"]
    rays: Rays
    hits: Hits
    sides: Float32[ndarray, "2 n"]


def whole_pixels(scene: HomeScene, camera: RayCamera) -> PixelParts:
    """Return all pixels, row by row, each with the ray through its centre."""
    pixels = camera.pixels()
    columns, rows = camera.centres(pixels)
    rays = camera.rays(pixels, columns, rows)
    hits = scene.cast(rays.origins_m, rays.directions)
    return PixelParts(pixels, columns, rows, rays, hits, np.ones((2, len(pixels)), np.float32))


def parts_of(
    scene: HomeScene, camera: RayCamera, pixels: Int64[ndarray, " n"], rays_px: Float32[ndarray, "k 2"], least: float
) -> tuple[PixelParts, Float32[ndarray, " p"]]:
    """Return the parts of these pixels, pixel by pixel, and the share of the pixel's rays in each.

    rays_px: offsets from the pixel's centre. least: area of the smallest part, as a share of the pixel.
    """
    count, centres = len(rays_px), camera.centres(pixels)
    columns, rows = ((centre[:, None] + offset).ravel() for centre, offset in zip(centres, rays_px.T, strict=True))
    rays = camera.rays(np.repeat(pixels, count), columns, rows)
    hits = scene.cast(rays.origins_m, rays.directions)
    order, starts = _group(scene, hits, rays_px)
    offsets = rays_px[order % count]
    values = (offsets, offsets * offsets, hits.barycentric[order], hits.distance[order, None])
    rays_in = np.diff(starts, append=len(order)).astype(np.float32)
    means = np.add.reduceat(np.concatenate(values, axis=1), starts, axis=0) / rays_in[:, None]
    pixel = starts // count
    columns, rows = (centre[pixel] + offset for centre, offset in zip(centres, means.T[:2], strict=True))
    found = Hits(hits.triangle[order[starts]], np.ascontiguousarray(means[:, 4:6]), np.ascontiguousarray(means[:, 6]))
    # offsets that fill a width evenly have a variance of its square / 12
    squares = 12 * np.maximum(means[:, 2:4] - means[:, :2] ** 2, 0) + np.float32(least)
    sides = np.sqrt(np.minimum(squares, 1)).T
    parts = PixelParts(pixels[pixel], columns, rows, camera.rays(pixels[pixel], columns, rows), found, sides)
    return parts, rays_in / np.float32(count)


def _group(
    scene: HomeScene, hits: Hits, rays_px: Float32[ndarray, "k 2"]
) -> tuple[Int64[ndarray, " r"], Int64[ndarray, " p"]]:
    """Return the order of the rays in which those of a part follow each other, and the place of each part's first."""
    right, down = np.floor((rays_px.T + 0.5) * np.array([[_CELLS_RIGHT], [_CELLS_DOWN]])).astype(np.int64)
    triangle = hits.triangle.reshape(-1, len(rays_px))
    glossy = scene.triangles.gloss[triangle] > 0
    part = (triangle + 1) * (_CELLS_RIGHT * _CELLS_DOWN) + glossy * (right * _CELLS_DOWN + down)
    order = np.argsort(part, axis=1)
    starts = np.flatnonzero(np.diff(np.take_along_axis(part, order, axis=1), axis=1, prepend=-1))
    return (order + len(rays_px) * np.arange(len(part))[:, None]).ravel(), starts
