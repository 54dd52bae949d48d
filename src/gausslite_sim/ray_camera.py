"""Rays through the pixels of a camera with a lens, whose rows may be exposed from different poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera, Lens
from gausslite.domain.errors import InvalidInputError

_NEWTON_STEPS = 20
_NEWTON_DIFFERENCE = 1e-6
_TOLERANCE = 1e-7
"""Largest error of an undistorted slope, distorted again: far below a pixel."""


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
            x, y = undistorted(self.lens, x.astype(np.float64), y.astype(np.float64))
        return x.astype(np.float32), y.astype(np.float32)


def undistorted(
    lens: Lens, x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the slopes of the rays that meet the image plane at (x, y): the inverse of `Lens.distort`, by Newton.

    Raises InvalidInputError for a point that no ray meets, beyond the range in which the model can be inverted.
    """
    u, v, h = x, y, _NEWTON_DIFFERENCE
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            error_x, error_y = (at - to for at, to in zip(lens.distort(u, v), (x, y), strict=True))
            if max(np.abs(error_x).max(initial=0.0), np.abs(error_y).max(initial=0.0)) <= _TOLERANCE:
                return u, v
            right, left, below, above = (lens.distort(u + du, v + dv) for du, dv in ((h, 0), (-h, 0), (0, h), (0, -h)))
            xu, yu, xv, yv = right[0] - left[0], right[1] - left[1], below[0] - above[0], below[1] - above[1]
            scale = 2 * h / (xu * yv - xv * yu)
            u, v = u - scale * (yv * error_x - xv * error_y), v - scale * (xu * error_y - yu * error_x)
    worst = int(np.argmax(np.nan_to_num(np.hypot(error_x, error_y), nan=np.inf)))
    raise InvalidInputError(
        f"lens {lens}: expected a model that can be inverted over the image, "
        f"got none at the slope ({x[worst]:.2f}, {y[worst]:.2f})"
    )
