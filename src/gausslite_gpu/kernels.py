"""The gsplat operations of this backend (Ye et al. 2025, Apache-2.0), and the projection of rows to their input."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import (
    LOG_SCALE,
    MEAN,
    MIN_ALPHA,
    NEAR_M,
    OPACITY_LOGIT,
    QUAT,
    RGB,
    TILE_PX,
    UPDATE_COUNT,
)
from gausslite_gpu.motion import determinants
from gausslite_gpu.tables import DeviceCamera, to_device


@dataclass(frozen=True, slots=True, eq=False)
class Footprints:
    """Input of the compositing kernels: splats in any order, in pixels of the rendered window.

    channels: red, green, blue and z. order_m: splats are blended in ascending order of it. radius_px: half the bounding
    box of alpha >= 1/255.
    """

    means_px: Float32[Tensor, "m 2"]
    conics: Float32[Tensor, "m 3"]
    opacities: Float32[Tensor, " m"]
    channels: Float32[Tensor, "m 4"]
    order_m: Float32[Tensor, " m"]
    radius_px: Float32[Tensor, "m 2"]


@runtime_checkable
class Kernels(Protocol):
    """Differentiable operations of gsplat on one device."""

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        ...

    def covariances(self, quats_wxyz: Float32[Tensor, "m 4"], scales_m: Float32[Tensor, "m 3"]) -> Tensor:
        """Return the covariances [m 3 3] in the frame of the means."""
        ...

    def project(
        self,
        points_m: Float32[Tensor, "m 3"],
        covariances_m2: Float32[Tensor, "m 3 3"],
        intrinsics: Float32[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return means [m 2] and covariances [m 2 2] in the image of this width and height, from the camera frame."""
        ...

    def composite(
        self, footprints: Footprints, size: tuple[int, int], tiles: Bool[Tensor, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        """Return channels [h w 4] and alpha [h w] of a window of this width and height; zero outside the tiles."""
        ...


def load_gsplat() -> ModuleType:
    """Import gsplat and its kernels; unless the wheel contains them, the first use compiles them in some minutes.

    Raises KernelError without a CUDA toolkit, ImportError without gsplat.
    """
    import gsplat
    from gsplat.cuda import _backend

    if _backend._C is None:
        raise KernelError("cuda backend: expected nvcc to compile gsplat's kernels with, got no CUDA toolkit")
    return cast(ModuleType, gsplat)


def open_device(name: str = "cuda") -> GsplatKernels:
    """Return gsplat on a CUDA device, as "cuda" or "cuda:1". Raises KernelError if it cannot be used."""
    device = torch.device(name)
    if device.type != "cuda":
        raise KernelError(f"cuda backend: expected device cuda or cuda:N, got {name}")
    if not torch.cuda.is_available():
        raise KernelError("cuda backend: expected a CUDA device that torch can use, got none")
    try:
        return GsplatKernels(load_gsplat(), device)
    except ImportError as reason:
        raise KernelError(f"cuda backend: needs gsplat; pip install gausslite[cuda] ({reason})") from reason


class GsplatKernels:
    """gsplat on a CUDA device."""

    def __init__(self, gsplat: Any, device: torch.device) -> None:
        self._gsplat = gsplat
        self._device = device

    @property
    def device(self) -> torch.device:
        """The CUDA device."""
        return self._device

    def covariances(self, quats_wxyz: Float32[Tensor, "m 4"], scales_m: Float32[Tensor, "m 3"]) -> Tensor:
        """Return the covariances [m 3 3]."""
        covariances, _ = self._gsplat.quat_scale_to_covar_preci(quats_wxyz, scales_m, compute_preci=False)
        return cast(Tensor, covariances)

    def project(
        self,
        points_m: Float32[Tensor, "m 3"],
        covariances_m2: Float32[Tensor, "m 3 3"],
        intrinsics: Float32[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return means and covariances in the image."""
        means_px, covariances_px2 = self._gsplat.proj(points_m[None], covariances_m2[None], intrinsics[None], *size)
        return means_px[0], covariances_px2[0]

    def composite(
        self, footprints: Footprints, size: tuple[int, int], tiles: Bool[Tensor, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        """Sort the splats by tile and depth, and blend them front to back."""
        width_px, height_px = size
        tile_rows, tile_columns = -(-height_px // TILE_PX), -(-width_px // TILE_PX)
        _, crossings, owners = self._gsplat.isect_tiles(
            footprints.means_px.detach()[None],
            footprints.radius_px.ceil().to(torch.int32)[None],
            footprints.order_m[None],
            TILE_PX,
            tile_columns,
            tile_rows,
        )
        channels, alpha = self._gsplat.rasterize_to_pixels(
            footprints.means_px[None],
            footprints.conics[None],
            footprints.channels[None],
            footprints.opacities[None],
            image_width=width_px,
            image_height=height_px,
            tile_size=TILE_PX,
            isect_offsets=self._gsplat.isect_offset_encode(crossings, 1, tile_columns, tile_rows),
            flatten_ids=owners,
            masks=None if tiles is None else tiles[None],
        )
        if tiles is None:
            return channels[0], alpha[0, ..., 0]
        # gsplat's kernel does not write alpha in inactive tiles
        is_active = tiles.repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)[:height_px, :width_px]
        return torch.where(is_active[..., None], channels[0], 0.0), torch.where(is_active, alpha[0, ..., 0], 0.0)


def project(
    kernels: Kernels, rows: Float32[Tensor, "m 16"], device_camera: DeviceCamera, T_camera_world: Float32[Tensor, "4 4"]
) -> Footprints:
    """Return the footprints of these rows in the whole image, in the same order."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    points_m = _rotate(rows[:, MEAN], R) + t
    motion, dilation_px2 = device_camera.motion, device_camera.dilation_px2
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
        variance_x, variance_y = variance_x + dilation_px2, variance_y + dilation_px2
    else:
        velocity = motion.image_velocity(points_m)
        variance_x, covariance, variance_y = motion.shear((variance_x, covariance, variance_y), velocity, s_per_row)
        sharp = variance_x + dilation_px2, covariance, variance_y + dilation_px2
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
