"""Rays through the pixels of a camera with a lens, whose rows may be exposed from different poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera, Lens


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Origins and directions in the world; a direction has length 1 along the optical axis, so t is the depth."""

    origins_m: Float32[ndarray, "n 3"]
    directions: Float32[ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class RayCamera:
    """A camera with its pose, one for the whole image or one for each row, and its lens; None for a pinhole."""

    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"] | Float64[ndarray, "h 4 4"]
    lens: Lens | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.camera.height_px, self.camera.width_px

    def pixels(self) -> Int64[ndarray, " n"]:
        """Return the flat indices of all pixels, row by row."""
        return np.arange(self.camera.height_px * self.camera.width_px)

    def centres(self, pixels: Int64[ndarray, " n"]) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
        """Return the image coordinates (column, row) of the pixels' centres, at +0.5."""
        rows, columns = np.divmod(pixels, self.camera.width_px)
        return columns.astype(np.float32) + np.float32(0.5), rows.astype(np.float32) + np.float32(0.5)

    def rays(self, pixels: Int64[ndarray, " n"], columns: Float32[ndarray, " n"], rows: Float32[ndarray, " n"]) -> Rays:
        """Return the rays through these image coordinates, each exposed at the time of its pixel's row."""
        x, y = self._slopes(columns, rows)
        T = self.T_world_camera.astype(np.float32)
        if T.ndim == 3:
            T = T[pixels // self.camera.width_px]
        # no matrix product: its rounding may depend on the number of rays and cores
        directions = np.stack([T[..., k, 0] * x + T[..., k, 1] * y + T[..., k, 2] for k in range(3)], axis=1)
        origins_m = np.broadcast_to(T[..., :3, 3], directions.shape)
        return Rays(np.ascontiguousarray(origins_m), np.ascontiguousarray(directions))

    def _slopes(
        self, columns: Float32[ndarray, " n"], rows: Float32[ndarray, " n"]
    ) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
        """Return the slopes of the rays through these image coordinates. Raises InvalidInputError."""
        x, y = self.camera.slopes(columns, rows)
        if self.lens is not None:
            x, y = self.lens.undistort(x.astype(np.float64), y.astype(np.float64))
        return x.astype(np.float32), y.astype(np.float32)
