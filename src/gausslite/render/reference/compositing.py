"""Blend ellipses front to back, one tile at a time, to bound the memory (3DGS, Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite.render.rasterizer import TILE_PX
from gausslite.render.reference.projection import MIN_ALPHA, Ellipses, tile_grid

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Limits:
    """Where alpha is clamped, and whether the splat that reaches the minimum transmittance is blended."""

    max_alpha: float = MAX_ALPHA
    blends_last_splat: bool = True


DEFAULT_LIMITS = Limits()


def composite(
    ellipses: Ellipses, pixels: Float64[Tensor, "p 2"], limits: Limits = DEFAULT_LIMITS
) -> Float64[Tensor, "p 5"]:
    """Return red, green, blue, depth and alpha at these pixel centres."""
    dx, dy = (pixels[None] - ellipses.means_px[:, None]).unbind(dim=2)
    a, b, c = ellipses.conics[:, :, None].unbind(dim=1)
    alpha = ellipses.opacities[:, None] * torch.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
    alpha = torch.where(alpha < MIN_ALPHA, 0.0, alpha.clamp(max=limits.max_alpha))
    transmittance = torch.cumprod(1.0 - alpha, dim=0)
    before = torch.cat([torch.ones_like(transmittance[:1]), transmittance[:-1]])
    hidden = before < MIN_TRANSMITTANCE if limits.blends_last_splat else transmittance <= MIN_TRANSMITTANCE
    weights = torch.where(hidden, 0.0, alpha * before)
    channels = torch.cat([ellipses.rgb, ellipses.z_m[:, None], torch.ones_like(ellipses.z_m)[:, None]], dim=1)
    return weights.T @ channels


def tile_slices(camera: Camera, tiles: Bool[ndarray, "th tw"] | None) -> Iterator[tuple[slice, slice]]:
    """Yield the image rows and columns of each rendered tile, clipped to the image."""
    tile_rows, tile_columns = tile_grid(camera)
    for row in range(tile_rows):
        for column in range(tile_columns):
            if tiles is None or tiles[row, column]:
                top, left = row * TILE_PX, column * TILE_PX
                yield (
                    slice(top, min(top + TILE_PX, camera.height_px)),
                    slice(left, min(left + TILE_PX, camera.width_px)),
                )


def render_images(
    ellipses: Ellipses, camera: Camera, tiles: Bool[ndarray, "th tw"] | None, limits: Limits = DEFAULT_LIMITS
) -> Float64[Tensor, "h w 5"]:
    """Return the images, differentiable if the ellipses are; pixels outside the tiles are zero."""
    images = torch.zeros(camera.height_px, camera.width_px, 5, dtype=torch.float64)
    for rows, columns in tile_slices(camera, tiles):
        inside = _overlapping(ellipses, rows, columns)
        tile = composite(ellipses.take(inside), _centres(rows, columns), limits)
        images[rows, columns] = tile.reshape(rows.stop - rows.start, columns.stop - columns.start, 5)
    return images


def render_images_backward(
    ellipses: Ellipses,
    camera: Camera,
    tiles: Bool[ndarray, "th tw"] | None,
    d_images: Float64[Tensor, "h w 5"],
    limits: Limits = DEFAULT_LIMITS,
) -> tuple[Tensor, ...]:
    """Return the gradients of each of `ellipses.differentiable`; renders each tile again, with autograd."""
    sums = tuple(torch.zeros_like(column) for column in ellipses.differentiable)
    for rows, columns in tile_slices(camera, tiles):
        inside = _overlapping(ellipses, rows, columns)
        if len(inside) == 0:
            continue
        part = ellipses.take(inside).detached()
        tile = composite(part, _centres(rows, columns), limits)
        gradients = torch.autograd.grad(tile, part.differentiable, d_images[rows, columns].reshape(-1, 5))
        for total, gradient in zip(sums, gradients, strict=True):
            total.index_add_(0, inside, gradient)
    return sums


def _overlapping(ellipses: Ellipses, rows: slice, columns: slice) -> Tensor:
    """Return the positions of the ellipses whose bounding box overlaps the tile."""
    low = torch.tensor([columns.start, rows.start], dtype=torch.float64)
    high = torch.tensor([columns.stop, rows.stop], dtype=torch.float64)
    means_px = ellipses.means_px.detach()
    reaches = (means_px + ellipses.half_box_px >= low) & (means_px - ellipses.half_box_px <= high)
    return torch.nonzero(reaches.all(dim=1))[:, 0]


def _centres(rows: slice, columns: slice) -> Float64[Tensor, "p 2"]:
    y = torch.arange(rows.start, rows.stop, dtype=torch.float64) + 0.5
    x = torch.arange(columns.start, columns.stop, dtype=torch.float64) + 0.5
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([grid_x, grid_y], dim=-1).reshape(-1, 2)
