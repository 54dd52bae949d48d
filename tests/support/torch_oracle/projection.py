"""Project rows to ellipses in the image (EWA splatting), also of a moving camera, in differentiable float64."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.render.rasterizer import (
    DILATION_PX2,
    LOG_SCALE,
    MEAN,
    MIN_ALPHA,
    NEAR_M,
    OPACITY_LOGIT,
    QUAT,
    RGB,
    TANGENT_MARGIN,
    TILE_PX,
)
from gausslite_gpu.motion import Covariances, ImageMotion, determinants


@dataclass(frozen=True, slots=True, eq=False)
class Ellipses:
    """The visible splats, nearest first (with a moving camera, at the middle of the readout).

    conics: (a, b, c) of the inverse 2D covariance [[a, b], [b, c]].
    half_box_px: half the bounding box of the ellipse alpha >= 1/255, without a gradient.
    """

    row_ids: Int64[Tensor, " m"]
    means_px: Float64[Tensor, "m 2"]
    conics: Float64[Tensor, "m 3"]
    opacities: Float64[Tensor, " m"]
    rgb: Float64[Tensor, "m 3"]
    z_m: Float64[Tensor, " m"]
    half_box_px: Float64[Tensor, "m 2"]

    @property
    def differentiable(self) -> tuple[Tensor, ...]:
        """The columns with gradients."""
        return self.means_px, self.conics, self.opacities, self.rgb, self.z_m

    def detached(self) -> Ellipses:
        """Return the same ellipses as leaves of a new graph."""
        means_px, conics, opacities, rgb, z_m = (column.detach().requires_grad_() for column in self.differentiable)
        return replace(self, means_px=means_px, conics=conics, opacities=opacities, rgb=rgb, z_m=z_m)

    def take(self, chosen: Tensor) -> Ellipses:
        """Return the ellipses at these positions, or where this mask is True, in the same order."""
        return Ellipses(*(getattr(self, column.name)[chosen] for column in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class ImageModel:
    """What an image depends on besides the pose."""

    camera: Camera
    motion: ImageMotion | None
    dilation_px2: float

    @classmethod
    def of(cls, camera: Camera, motion: CameraMotion | None = None, dilation_px2: float = DILATION_PX2) -> ImageModel:
        """Return the model in double precision."""
        return cls(camera, ImageMotion.of(camera, motion, torch.float64), dilation_px2)


def project(
    rows: Float64[Tensor, "n 16"],
    model: ImageModel,
    T_camera_world: Float64[Tensor, "4 4"],
    ids: Int64[Tensor, " k"] | None = None,
    tiles: Bool[ndarray, "th tw"] | None = None,
) -> Ellipses:
    """Return the ellipses of the rows (of `ids`, if given) that can touch a pixel of `tiles`, nearest first."""
    with torch.no_grad():
        is_valid = torch.isfinite(rows[:, :14]).all(dim=1) & (rows[:, QUAT].abs().sum(dim=1) > 0)
        row_ids = torch.nonzero(is_valid)[:, 0] if ids is None else ids[is_valid[ids]]
        z_m = rows[row_ids, MEAN] @ T_camera_world[2, :3] + T_camera_world[2, 3]
        ellipses = _ellipses(rows, row_ids[z_m >= NEAR_M], model, T_camera_world)
        ellipses = ellipses.take(ellipses.z_m >= NEAR_M)
        finite = torch.isfinite(ellipses.half_box_px).all(dim=1) & torch.isfinite(ellipses.means_px).all(dim=1)
        ellipses = ellipses.take(finite & (ellipses.opacities > MIN_ALPHA))
        ellipses = ellipses.take(_touches_tiles(ellipses, model.camera, tiles))
        # with a moving camera too, the order is that of the middle of the readout
        middle_z_m = rows[ellipses.row_ids, MEAN] @ T_camera_world[2, :3] + T_camera_world[2, 3]
        row_ids = ellipses.row_ids[torch.argsort(middle_z_m, stable=True)]
    # project again with gradients, only the rows that are not culled
    return _ellipses(rows, row_ids, model, T_camera_world)


def _ellipses(
    rows: Float64[Tensor, "n 16"],
    row_ids: Int64[Tensor, " m"],
    model: ImageModel,
    T_camera_world: Float64[Tensor, "4 4"],
) -> Ellipses:
    camera, motion = model.camera, model.motion
    kept = rows[row_ids]
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    points = kept[:, MEAN] @ R.T + t
    opacities = torch.sigmoid(kept[:, OPACITY_LOGIT])
    if motion is None:
        variance_x, covariance, variance_y = _dilated(_covariances_px2(kept, points, R, camera), model.dilation_px2)
    else:
        points, s_per_row = motion.expose(points)
        velocity = motion.image_velocity(points)
        covariances = motion.shear(_covariances_px2(kept, points, R, camera), velocity, s_per_row)
        (variance_x, covariance, variance_y), peak = motion.blur(_dilated(covariances, model.dilation_px2), velocity)
        opacities = opacities * peak
    z = points[:, 2]
    means_px = torch.stack(
        [camera.fx_px * points[:, 0] / z + camera.cx_px, camera.fy_px * points[:, 1] / z + camera.cy_px], dim=1
    )
    determinant = determinants((variance_x, covariance, variance_y))
    conics = torch.stack([variance_y, -covariance, variance_x], dim=1) / determinant[:, None]
    # the boundary alpha = 1/255 is an ellipse at this squared Mahalanobis distance
    reach = 2.0 * torch.log(opacities.detach() / MIN_ALPHA).clamp(min=0.0)
    half_box_px = torch.sqrt(reach[:, None] * torch.stack([variance_x, variance_y], dim=1).detach())
    return Ellipses(
        row_ids=row_ids,
        means_px=means_px,
        conics=conics,
        opacities=opacities,
        rgb=kept[:, RGB],
        z_m=z,
        half_box_px=half_box_px,
    )


def _dilated(covariances: Covariances, dilation_px2: float) -> Covariances:
    variance_x, covariance, variance_y = covariances
    return variance_x + dilation_px2, covariance, variance_y + dilation_px2


def _covariances_px2(
    kept: Float64[Tensor, "m 16"], points: Float64[Tensor, "m 3"], R: Float64[Tensor, "3 3"], camera: Camera
) -> Covariances:
    """Return var x, cov xy, var y of J R Σ Rᵀ Jᵀ; J is evaluated at the clamped tangent."""
    x, y, z = points.unbind(dim=1)
    limit_x = TANGENT_MARGIN * 0.5 * camera.width_px / camera.fx_px
    limit_y = TANGENT_MARGIN * 0.5 * camera.height_px / camera.fy_px
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    jacobian_x = torch.stack([camera.fx_px / z, zero, -camera.fx_px * u / z], dim=1)
    jacobian_y = torch.stack([zero, camera.fy_px / z, -camera.fy_px * v / z], dim=1)
    spread = R @ _rotations(kept[:, QUAT]) * torch.exp(kept[:, LOG_SCALE])[:, None, :]
    spread_x = torch.einsum("mi,mij->mj", jacobian_x, spread)
    spread_y = torch.einsum("mi,mij->mj", jacobian_y, spread)
    return (spread_x * spread_x).sum(dim=1), (spread_x * spread_y).sum(dim=1), (spread_y * spread_y).sum(dim=1)


def _rotations(quats_wxyz: Float64[Tensor, "m 4"]) -> Float64[Tensor, "m 3 3"]:
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=1, keepdim=True)).unbind(dim=1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)


def _touches_tiles(ellipses: Ellipses, camera: Camera, tiles: Bool[ndarray, "th tw"] | None) -> Bool[Tensor, " m"]:
    """Return True where the bounding box contains a pixel centre of the tiles (None: of the image)."""
    last = torch.tensor([camera.width_px - 1, camera.height_px - 1], dtype=torch.float64)
    low = torch.ceil(ellipses.means_px - ellipses.half_box_px - 0.5).clamp(min=0.0)
    high = torch.minimum(torch.floor(ellipses.means_px + ellipses.half_box_px - 0.5), last)
    hit = (low <= high).all(dim=1)
    if tiles is None:
        return hit
    # number of rendered tiles in the box, from four corners of a summed-area table
    table = torch.from_numpy(np.pad(tiles.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))))
    x0, y0 = (torch.minimum(low, last).long() // TILE_PX).unbind(dim=1)
    x1, y1 = (high.clamp(min=0.0).long() // TILE_PX + 1).unbind(dim=1)
    return hit & (table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0)


def skew(v: Float64[Tensor, "3"]) -> Float64[Tensor, "3 3"]:
    """Return the matrix of the cross product with v."""
    zero = torch.zeros((), dtype=v.dtype)
    x, y, z = v.unbind()
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def apply_twist(T_camera_world: Float64[Tensor, "4 4"], twist: Float64[Tensor, "6"]) -> Float64[Tensor, "4 4"]:
    """Return exp(twist) T_camera_world to first order; the derivative at twist 0 is exact."""
    top = torch.cat([skew(twist[3:]), twist[:3, None]], dim=1)
    generator = torch.cat([top, torch.zeros(1, 4, dtype=torch.float64)])
    return T_camera_world + generator @ T_camera_world


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Return the numbers of tile rows and columns of the image."""
    return math.ceil(camera.height_px / TILE_PX), math.ceil(camera.width_px / TILE_PX)
