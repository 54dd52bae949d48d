"""The training loss of Eq. (1) on a rendered image, as defined in LossWeights."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import conv2d

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.render.rasterizer import LossWeights

MIN_DEPTH_ALPHA = 0.5
_WINDOW_PX = 11
_SIGMA_PX = 1.5
_C1, _C2 = 1e-4, 9e-4


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceView:
    """A training image in float64, colours in [0, 1]."""

    camera: Camera
    rgb: Float64[Tensor, "h w 3"]
    depth_m: Float64[Tensor, "h w"]
    pixel_weights: Float64[Tensor, "h w"]
    motion: CameraMotion | None = None


def training_loss(
    images: Float64[Tensor, "h w 5"], view: ReferenceView, loss: LossWeights, masked: bool
) -> Float64[Tensor, ""]:
    """Return the weighted sum of the three terms."""
    pixel_weights = view.pixel_weights if masked else torch.ones_like(view.pixel_weights)
    total = pixel_weights.sum()
    if total == 0:
        return images.sum() * 0.0
    rgb, depth_m, alpha = images[..., :3], images[..., 3], images[..., 4]
    colour = (pixel_weights[..., None] * (rgb - view.rgb).abs()).sum() / (3.0 * total)
    measured = (alpha > MIN_DEPTH_ALPHA) & (view.depth_m > 0)
    error_m = (depth_m[measured] / alpha[measured] - view.depth_m[measured]).abs()
    depth = (pixel_weights[measured] * error_m).sum() / total
    similarity = (pixel_weights[..., None] * ssim_map(rgb, view.rgb)).sum() / (3.0 * total)
    value = loss.colour * colour + loss.depth * depth + loss.ssim * (1.0 - similarity)
    return value * (total / pixel_weights.numel()) if loss.normalise_by_image else value


def ssim_map(a: Float64[Tensor, "h w 3"], b: Float64[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    """Return the SSIM of every pixel and channel, with zero padding (Wang et al. 2004)."""
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a = _blur(a * a) - mean_a * mean_a
    variance_b = _blur(b * b) - mean_b * mean_b
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2.0 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
    return luminance * (2.0 * covariance + _C2) / (variance_a + variance_b + _C2)


def _blur(image: Float64[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    reach = _WINDOW_PX // 2
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
    kernel = torch.exp(-offsets.square() / (2.0 * _SIGMA_PX**2))
    kernel = kernel / kernel.sum()
    planes = image.permute(2, 0, 1)[:, None]
    planes = conv2d(planes, kernel.reshape(1, 1, 1, -1), padding=(0, reach))
    planes = conv2d(planes, kernel.reshape(1, 1, -1, 1), padding=(reach, 0))
    return planes[:, 0].permute(1, 2, 0)
