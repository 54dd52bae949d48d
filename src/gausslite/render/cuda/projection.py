"""Select the visible rows on the device, and project them differentiably to footprints in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.render.cuda.kernels import Footprints, Kernels
from gausslite.render.cuda.tables import to_device
from gausslite.render.rasterizer import LOG_SCALE, MEAN, NEAR_M, OPACITY_LOGIT, QUAT, RGB, TILE_PX, UPDATE_COUNT
from gausslite.render.reference.motion import ImageMotion, determinants
from gausslite.render.reference.projection import LOW_PASS_PX2, MIN_ALPHA


@dataclass(frozen=True, slots=True, eq=False)
class DeviceCamera:
    """A camera on the device, with the principal point at the image centre; shift_px: from there to the real one.

    gsplat clamps the tangent around the optical axis, the interface around the centre of the image. They agree with the
    principal point at the centre; shift_px is added to the projected means.
    """

    size: tuple[int, int]
    intrinsics: Float32[Tensor, "3 3"]
    shift_px: Float32[Tensor, "2"]
    half_size_px: Float32[Tensor, "2"]
    motion: ImageMotion | None

    @classmethod
    def of(cls, camera: Camera, device: torch.device, motion: CameraMotion | None = None) -> DeviceCamera:
        """Return the device form of this camera and its motion."""
        middle_px = np.array([camera.width_px, camera.height_px]) / 2.0
        intrinsics = [[camera.fx_px, 0.0, middle_px[0]], [0.0, camera.fy_px, middle_px[1]], [0.0, 0.0, 1.0]]
        shift_px = np.array([camera.cx_px, camera.cy_px]) - middle_px
        return cls(
            (camera.width_px, camera.height_px),
            torch.tensor(intrinsics, dtype=torch.float32, device=device),
            torch.tensor(shift_px, dtype=torch.float32, device=device),
            torch.tensor(middle_px, dtype=torch.float32, device=device),
            ImageMotion.of(camera, motion, torch.float32, device),
        )


def project(
    kernels: Kernels, rows: Float32[Tensor, "m 16"], device_camera: DeviceCamera, T_camera_world: Float32[Tensor, "4 4"]
) -> Footprints:
    """Return the footprints of these rows in the whole image, in the same order."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    points_m, motion = _rotate(rows[:, MEAN], R) + t, device_camera.motion
    order_m = points_m[:, 2].detach()
    if motion is not None:
        points_m, s_per_row = motion.expose(points_m)
    covariances_m2 = kernels.covariances(_unit(rows[:, QUAT]), rows[:, LOG_SCALE].exp())
    # R Σ Rᵀ by two rotations of its rows: much faster than a batch of small products
    rotated_m2 = _rotate(_rotate(covariances_m2, R).transpose(1, 2), R)
    means_px, covariances_px2 = kernels.project(points_m, rotated_m2, device_camera.intrinsics, device_camera.size)
    variance_x, variance_y = covariances_px2[:, 0, 0], covariances_px2[:, 1, 1]
    covariance = 0.5 * (covariances_px2[:, 0, 1] + covariances_px2[:, 1, 0])
    # a sigmoid whose derivative is precise near 1
    opacities = logsigmoid(rows[:, OPACITY_LOGIT]).exp()
    if motion is None:
        variance_x, variance_y = variance_x + LOW_PASS_PX2, variance_y + LOW_PASS_PX2
    else:
        velocity = motion.image_velocity(points_m)
        variance_x, covariance, variance_y = motion.shear((variance_x, covariance, variance_y), velocity, s_per_row)
        sharp = variance_x + LOW_PASS_PX2, covariance, variance_y + LOW_PASS_PX2
        (variance_x, covariance, variance_y), peak = motion.blur(sharp, velocity)
        opacities = opacities * peak
    determinant = determinants((variance_x, covariance, variance_y))
    # the boundary alpha = 1/255 is an ellipse at this squared Mahalanobis distance
    reach = 2.0 * torch.log(opacities.detach() / MIN_ALPHA).clamp(min=0.0)
    return Footprints(
        means_px=means_px + device_camera.shift_px,
        conics=torch.stack([variance_y, -covariance, variance_x], dim=1) / determinant[:, None],
        opacities=opacities,
        channels=torch.cat([rows[:, RGB], points_m[:, 2:]], dim=1),
        order_m=order_m,
        radius_px=torch.sqrt(reach[:, None] * torch.stack([variance_x, variance_y], dim=1).detach()),
    )


@torch.no_grad()
def visible_rows(
    kernels: Kernels,
    rows: Float32[Tensor, "n 16"],
    device_camera: DeviceCamera,
    T_camera_world: Float32[Tensor, "4 4"],
    ids: Int64[Tensor, " k"] | None,
    tiles: Bool[ndarray, "th tw"] | None,
) -> Int64[Tensor, " m"]:
    """Return the numbers of the rows (of `ids`) whose ellipse can touch a pixel of `tiles`, ascending.

    All candidates are projected and the invalid ones removed at the end, so that the host waits for one number only.
    """
    candidates = rows if ids is None else rows[ids]
    is_valid = torch.isfinite(candidates[:, :UPDATE_COUNT]).all(dim=1) & (candidates[:, QUAT] != 0).any(dim=1)
    is_valid &= candidates[:, MEAN] @ T_camera_world[2, :3] + T_camera_world[2, 3] >= NEAR_M
    footprints = project(kernels, candidates, device_camera, T_camera_world)
    boxes_px = torch.cat([footprints.means_px, footprints.radius_px], dim=1)
    is_valid &= torch.isfinite(footprints.conics).all(dim=1) & torch.isfinite(boxes_px).all(dim=1)
    is_valid &= (footprints.opacities > MIN_ALPHA) & (footprints.channels[:, 3] >= NEAR_M)
    boxes_px = torch.where(is_valid[:, None], boxes_px, 0.0)
    chosen = torch.nonzero(is_valid & _touches(boxes_px[:, :2], boxes_px[:, 2:], device_camera, tiles))[:, 0]
    return chosen if ids is None else ids[chosen]


def _unit(quats_wxyz: Float32[Tensor, "m 4"]) -> Float32[Tensor, "m 4"]:
    """Return unit quaternions, for any length but zero; scales first, so that no square overflows."""
    scaled = quats_wxyz / quats_wxyz.detach().abs().amax(dim=1, keepdim=True)
    return normalize(scaled, dim=1)


def _touches(
    means_px: Float32[Tensor, "m 2"],
    radius_px: Float32[Tensor, "m 2"],
    device_camera: DeviceCamera,
    tiles: Bool[ndarray, "th tw"] | None,
) -> Bool[Tensor, " m"]:
    """Return True where the bounding box contains a pixel centre of the tiles (None: of the image)."""
    last = 2.0 * device_camera.half_size_px - 1.0
    low = torch.ceil(means_px - radius_px - 0.5).clamp(min=0.0)
    high = torch.minimum(torch.floor(means_px + radius_px - 0.5), last)
    hit = (low <= high).all(dim=1)
    if tiles is None:
        return hit
    # number of rendered tiles in the box, from four corners of a summed-area table
    table = to_device(np.pad(tiles.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))), means_px.device)
    x0, y0 = (torch.minimum(low, last).long() // TILE_PX).unbind(dim=1)
    x1, y1 = (high.clamp(min=0.0).long() // TILE_PX + 1).unbind(dim=1)
    return hit & (table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0)


def _rotate(vectors: Tensor, R: Tensor) -> Tensor:
    """Return vectors @ R.T of shape (..., 3), with a result for each vector that does not depend on the others.

    A matrix product rounds by the number of rows and by the processor, which shows in thin splats.
    """
    return vectors[..., 0:1] * R[:, 0] + vectors[..., 1:2] * R[:, 1] + vectors[..., 2:3] * R[:, 2]
