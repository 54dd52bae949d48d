"""From rows on the device to footprints in the image: choose what is visible, then project that, differentiably."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from gausslite.domain.camera import Camera
from gausslite.render.cuda.kernels import Footprints, Kernels
from gausslite.render.cuda.tables import to_device
from gausslite.render.rasterizer import LOG_SCALE, MEAN, NEAR_M, OPACITY_LOGIT, QUAT, RGB, TILE_PX, UPDATE_COUNT
from gausslite.render.reference.projection import LOW_PASS_PX2, MIN_ALPHA


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A camera on the device. shift_px: from the image's middle, where gsplat is told the axis goes, to where it does.

    gsplat clamps the tangent about the axis, the seam about the middle of a symmetric field of view; with the axis in
    the middle they agree, and a shift of the means does the rest.
    """

    size: tuple[int, int]
    intrinsics: Float32[Tensor, "3 3"]
    shift_px: Float32[Tensor, "2"]
    half_size_px: Float32[Tensor, "2"]

    @classmethod
    def of(cls, camera: Camera, device: torch.device) -> Lens:
        """The lens of this camera."""
        middle_px = np.array([camera.width_px, camera.height_px]) / 2.0
        intrinsics = [[camera.fx_px, 0.0, middle_px[0]], [0.0, camera.fy_px, middle_px[1]], [0.0, 0.0, 1.0]]
        shift_px = np.array([camera.cx_px, camera.cy_px]) - middle_px
        return cls(
            (camera.width_px, camera.height_px),
            torch.tensor(intrinsics, dtype=torch.float32, device=device),
            torch.tensor(shift_px, dtype=torch.float32, device=device),
            torch.tensor(middle_px, dtype=torch.float32, device=device),
        )


def project(
    kernels: Kernels, rows: Float32[Tensor, "m 16"], lens: Lens, T_camera_world: Float32[Tensor, "4 4"]
) -> Footprints:
    """Footprints of these rows in the whole image, in their order."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    points_m = rows[:, MEAN] @ R.T + t
    spread_m2 = kernels.covariances(_unit(rows[:, QUAT]), rows[:, LOG_SCALE].exp())
    # R Σ Rᵀ by two products with one small matrix each, which are far faster than a batch of small ones
    turned_m2 = (spread_m2 @ R.T).transpose(1, 2) @ R.T
    means_px, covariances_px2 = kernels.project(points_m, turned_m2, lens.intrinsics, lens.size)
    variance_x, variance_y = covariances_px2[:, 0, 0] + LOW_PASS_PX2, covariances_px2[:, 1, 1] + LOW_PASS_PX2
    covariance = 0.5 * (covariances_px2[:, 0, 1] + covariances_px2[:, 1, 0])
    determinant = variance_x * variance_y - covariance * covariance
    # a sigmoid whose slope keeps its digits where it is nearly 1
    opacities = logsigmoid(rows[:, OPACITY_LOGIT]).exp()
    # the boundary alpha = 1/255 is an ellipse at this squared Mahalanobis distance
    reach = 2.0 * torch.log(opacities.detach() / MIN_ALPHA).clamp(min=0.0)
    return Footprints(
        means_px=means_px + lens.shift_px,
        conics=torch.stack([variance_y, -covariance, variance_x], dim=1) / determinant[:, None],
        opacities=opacities,
        channels=torch.cat([rows[:, RGB], points_m[:, 2:]], dim=1),
        radius_px=torch.sqrt(reach[:, None] * torch.stack([variance_x, variance_y], dim=1).detach()),
    )


@torch.no_grad()
def visible_rows(
    kernels: Kernels,
    rows: Float32[Tensor, "n 16"],
    lens: Lens,
    T_camera_world: Float32[Tensor, "4 4"],
    ids: Int64[Tensor, " k"] | None,
    tiles: Bool[ndarray, "th tw"] | None,
) -> Int64[Tensor, " m"]:
    """Numbers of the rows (among `ids`) whose ellipse can touch a pixel of `tiles`, ascending.

    What cannot be drawn is projected like the rest and left out at the end: the host waits for one number only.
    """
    candidates = rows if ids is None else rows[ids]
    drawable = torch.isfinite(candidates[:, :UPDATE_COUNT]).all(dim=1) & (candidates[:, QUAT] != 0).any(dim=1)
    drawable &= candidates[:, MEAN] @ T_camera_world[2, :3] + T_camera_world[2, 3] >= NEAR_M
    footprints = project(kernels, candidates, lens, T_camera_world)
    boxes_px = torch.cat([footprints.means_px, footprints.radius_px], dim=1)
    drawable &= torch.isfinite(footprints.conics).all(dim=1) & torch.isfinite(boxes_px).all(dim=1)
    drawable &= footprints.opacities > MIN_ALPHA
    boxes_px = torch.where(drawable[:, None], boxes_px, 0.0)
    chosen = torch.nonzero(drawable & _touches(boxes_px[:, :2], boxes_px[:, 2:], lens, tiles))[:, 0]
    return chosen if ids is None else ids[chosen]


def _unit(quats_wxyz: Float32[Tensor, "m 4"]) -> Float32[Tensor, "m 4"]:
    """Quaternions of length one, from any length but zero: scaled first, so that no square runs out of range."""
    scaled = quats_wxyz / quats_wxyz.detach().abs().amax(dim=1, keepdim=True)
    return normalize(scaled, dim=1)


def _touches(
    means_px: Float32[Tensor, "m 2"],
    radius_px: Float32[Tensor, "m 2"],
    lens: Lens,
    tiles: Bool[ndarray, "th tw"] | None,
) -> Bool[Tensor, " m"]:
    """True where the bounding box holds the centre of a pixel of the tiles (of the image, when they are None)."""
    last = 2.0 * lens.half_size_px - 1.0
    low = torch.ceil(means_px - radius_px - 0.5).clamp(min=0.0)
    high = torch.minimum(torch.floor(means_px + radius_px - 0.5), last)
    hit = (low <= high).all(dim=1)
    if tiles is None:
        return hit
    # how many of the tiles lie in the box, by four corners of a summed-area table
    table = to_device(np.pad(tiles.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))), means_px.device)
    x0, y0 = (torch.minimum(low, last).long() // TILE_PX).unbind(dim=1)
    x1, y1 = (high.clamp(min=0.0).long() // TILE_PX + 1).unbind(dim=1)
    return hit & (table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0)
