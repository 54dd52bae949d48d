"""Render a splat map from any pose on a CPU: evaluate its colours for the view, then rasterize."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.codec.ply import StoredMap
from gausslite.domain.camera import Camera
from gausslite.domain.pose import inverse
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import (
    DILATION_PX2,
    MIN_ALPHA,
    NEAR_M,
    RGB,
    TANGENT_MARGIN,
    Rendering,
    gaussians_to_rows,
)
from gausslite_render.harmonics import view_colours

_BLOCK = 4096
"""Gaussians that are coloured together: their coefficients of degree 3 fit the cache of a core."""
_MORTON_BITS = 10
_REACH_SIGMAS = float(np.sqrt(-2 * np.log(MIN_ALPHA)))
"""Farther from its mean, a splat of opacity 1 is not drawn."""
_ROUNDING = 1.0001


class SplatViewer:
    """Renders one map from many poses. Blocks of neighbouring Gaussians that no pixel can show are not coloured.

    threads: by default one per core that the process may use. Raises KernelError.
    """

    def __init__(self, splats: StoredMap, threads: int | None = None) -> None:
        gaussians, self._coefficients = splats.gaussians, list[Float32[ndarray, "k 3 b"]]()
        if splats.harmonics.any():
            order = by_place(gaussians.means_m)
            gaussians = gaussians.take(order)
            self._coefficients = [
                np.ascontiguousarray(splats.harmonics[order[start : start + _BLOCK]].transpose(2, 1, 0))
                for start in range(0, len(order), _BLOCK)
            ]
        self._gaussians, self._rows = gaussians, gaussians_to_rows(gaussians)
        if splats.harmonics.shape[2]:  # as 3DGS trains them
            self._rows[:, RGB] = np.maximum(self._rows[:, RGB], 0)
        self._bounds = np.array([self._sphere(block) for block in range(len(self._coefficients))]).reshape(-1, 5)
        self._rasterizer = CpuRasterizer(threads)
        self._threads = ThreadPoolExecutor(self._rasterizer.threads)

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Rendering:
        """Return the rendering from this camera pose; colours are clipped to [0, 1]. Raises ShapeError."""
        T_camera_world = inverse(T_world_camera)
        blocks = np.flatnonzero(self._may_show(camera, T_camera_world)).tolist()
        for _ in self._threads.map(lambda block: self._colour(block, T_world_camera[:3, 3]), blocks):
            pass
        rendering = self._rasterizer.forward(self._rows, camera, T_camera_world)
        # copies: the rasterizer may reuse its images
        return Rendering(np.clip(rendering.rgb, 0.0, 1.0), rendering.depth_m.copy(), rendering.alpha.copy(), None)

    def _colour(self, block: int, viewpoint_m: Float64[ndarray, "3"]) -> None:
        rows = slice(block * _BLOCK, (block + 1) * _BLOCK)
        means_m, rgb = self._gaussians.means_m[rows], self._gaussians.rgb[rows]
        self._rows[rows, RGB] = view_colours(means_m, rgb, self._coefficients[block], viewpoint_m)

    def _sphere(self, block: int) -> tuple[float, ...]:
        """Return the centre and radius of a sphere around a block's means, and its largest scale."""
        rows = slice(block * _BLOCK, (block + 1) * _BLOCK)
        means_m = self._gaussians.means_m[rows].astype(np.float64)
        centre_m = 0.5 * (means_m.min(axis=0) + means_m.max(axis=0))
        radius_m = float(np.linalg.norm(means_m - centre_m, axis=1).max()) * _ROUNDING
        return (*centre_m.tolist(), radius_m, float(self._gaussians.scales_m[rows].max()) * _ROUNDING)

    def _may_show(self, camera: Camera, T_camera_world: Float64[ndarray, "4 4"]) -> Bool[ndarray, " b"]:
        """Return False for blocks of which no pixel shows a splat.

        Along an image axis, a splat at depth z and slope t reaches `sigmas` times the root of
        (f · scale / z)² (1 + t²) + dilation from its mean, with t clamped as in the rasterizer.
        """
        x, y, z = T_camera_world[:3, :3] @ self._bounds[:, :3].T + T_camera_world[:3, 3:]
        radii_m, scales_m = self._bounds[:, 3:].T
        margin_px = _REACH_SIGMAS * DILATION_PX2**0.5
        first = camera.slopes(-margin_px, -margin_px)
        last = camera.slopes(camera.width_px + margin_px, camera.height_px + margin_px)
        shown: Bool[ndarray, " b"] = z + radii_m >= NEAR_M
        for side, low, high in zip((x, y), first, last, strict=True):
            steepest = TANGENT_MARGIN * max(abs(low), abs(high))
            reach_m = _REACH_SIGMAS * scales_m * np.hypot(1, steepest)
            shown &= side - high * z <= reach_m + radii_m * np.hypot(1, high)
            shown &= low * z - side <= reach_m + radii_m * np.hypot(1, low)
        return shown


def by_place(means_m: Float32[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return the order in which neighbours in space are close to each other: that of Morton codes."""
    low, high = np.percentile(means_m, (1, 99), axis=0)
    side_m = max(float((high - low).max()), np.finfo(np.float32).tiny)
    last = (1 << _MORTON_BITS) - 1
    cells = np.clip((means_m - low) / side_m * last, 0, last).astype(np.uint32)
    codes = np.zeros(len(means_m), np.uint32)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << np.uint32(3 * bit + axis)
    return np.argsort(codes, kind="stable")
