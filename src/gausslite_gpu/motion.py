"""The motion of a camera in an image: row by row readout and exposure, on torch tensors of any device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from gausslite.domain.camera import MAX_READOUT_SHARE, MIN_ROW_RATE, Camera, CameraMotion
from gausslite.render.rasterizer import TANGENT_MARGIN

Covariances: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""var x, cov xy, var y of the splats in the image, px²."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageMotion:
    """A camera with its motion, as tensors of one type on one device."""

    camera: Camera
    linear_m_s: Float[Tensor, "3"]
    angular_rad_s: Float[Tensor, "3"]
    readout_s: float
    exposure_s: float

    @classmethod
    def of(
        cls, camera: Camera, motion: CameraMotion | None, dtype: torch.dtype, device: torch.device | None = None
    ) -> ImageMotion | None:
        """Return the motion as tensors; None for a camera at rest."""
        if motion is None or motion.is_still:
            return None
        velocities = (motion.twist.linear_m_s, motion.twist.angular_rad_s)
        linear_m_s, angular_rad_s = (torch.tensor(velocity, dtype=dtype, device=device) for velocity in velocities)
        return cls(camera, linear_m_s, angular_rad_s, motion.readout_s, motion.exposure_s)

    def expose(self, points_m: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, " m"]]:
        """Return the points of the camera frame when their rows are exposed, and the time per row that they move.

        A point crosses rows at the speed s, to first order. It is recorded in row y = y0 + s t, which is exposed at
        t = readout (y / height - 1/2), so t = readout (y0 / height - 1/2) / (1 - s readout / height).
        """
        velocity = self._velocity(points_m)
        inverse_z = 1.0 / points_m[:, 2]
        tangent = points_m[:, 1] * inverse_z
        rows_per_s = self.camera.fy_px * inverse_z * (velocity[:, 1] - tangent * velocity[:, 2])
        readout_per_row = self.readout_s / self.camera.height_px
        row_rate = (1.0 - rows_per_s * readout_per_row).clamp(min=MIN_ROW_RATE)
        row = self.camera.fy_px * tangent + self.camera.cy_px
        limit_s = MAX_READOUT_SHARE * abs(self.readout_s)
        time_s = ((row * readout_per_row - 0.5 * self.readout_s) / row_rate).clamp(-limit_s, limit_s)
        return points_m + time_s[:, None] * velocity, readout_per_row / row_rate

    def image_velocity(self, points_m: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2"]:
        """Return the velocity of the points' images in px/s: the Jacobian (clamped tangents) times their velocity."""
        camera, velocity, z = self.camera, self._velocity(points_m), points_m[:, 2]
        speeds = []
        for axis, (focal_px, side_px) in enumerate(((camera.fx_px, camera.width_px), (camera.fy_px, camera.height_px))):
            limit = TANGENT_MARGIN * 0.5 * side_px / focal_px
            tangent = (points_m[:, axis] / z).clamp(-limit, limit)
            speeds.append(focal_px / z * (velocity[:, axis] - tangent * velocity[:, 2]))
        return torch.stack(speeds, dim=1)

    def shear(
        self, covariances: Covariances, image_velocity: Float[Tensor, "m 2"], s_per_row: Float[Tensor, " m"]
    ) -> Covariances:
        """Return the covariances of ellipses whose rows are exposed one after the other."""
        variance_x, covariance, variance_y = covariances
        sideways, stretch = s_per_row * image_velocity[:, 0], 1.0 + s_per_row * image_velocity[:, 1]
        return (
            variance_x + 2.0 * sideways * covariance + sideways * sideways * variance_y,
            stretch * (covariance + sideways * variance_y),
            stretch * stretch * variance_y,
        )

    def blur(
        self, covariances: Covariances, image_velocity: Float[Tensor, "m 2"]
    ) -> tuple[Covariances, Float[Tensor, " m"]]:
        """Return the covariances stretched along the path of the exposure, and the share of the peak that remains.

        The times of a pixel's exposure have the variance exposure² / 12. The integral of a splat over the image stays.
        """
        variance_x, covariance, variance_y = covariances
        path_x, path_y = (image_velocity * (self.exposure_s / math.sqrt(12.0))).unbind(dim=1)
        blurred = variance_x + path_x * path_x, covariance + path_x * path_y, variance_y + path_y * path_y
        return blurred, torch.sqrt(determinants(covariances) / determinants(blurred))

    def _velocity(self, points_m: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Return the velocity of world points in the camera frame: -(v + w x p)."""
        angular_rad_s = self.angular_rad_s.expand_as(points_m)
        velocity: Tensor = -(self.linear_m_s + torch.linalg.cross(angular_rad_s, points_m))
        return velocity


def determinants(covariances: Covariances) -> Float[Tensor, " m"]:
    """Return the determinant of each covariance."""
    variance_x, covariance, variance_y = covariances
    return variance_x * variance_y - covariance * covariance
