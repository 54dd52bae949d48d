"""The training loss on the device, on the image window in reach of the view's weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import conv2d

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.render.rasterizer import DILATION_PX2, TILE_PX, LossWeights
from gausslite_gpu.tables import DeviceCamera, to_device

MIN_DEPTH_ALPHA = 0.5
_REACH_PX, _SIGMA_PX = 5, 1.5
_C1, _C2 = 1e-4, 9e-4


@dataclass(frozen=True, slots=True)
class Window:
    """A part of the image between tile borders (or image borders), in tiles and in pixels."""

    tile_rows: slice
    tile_columns: slice
    rows: slice
    columns: slice

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.columns.stop - self.columns.start, self.rows.stop - self.rows.start

    @property
    def origin_px(self) -> tuple[int, int]:
        """Left and top."""
        return self.columns.start, self.rows.start

    @classmethod
    def whole(cls, camera: Camera) -> Window:
        """Return the window of the whole image."""
        return cls._between((0, camera.height_px), (0, camera.width_px), camera)

    @classmethod
    def around(cls, pixel_weights: Float32[ndarray, "h w"], camera: Camera) -> Window:
        """Return the window of all weighted pixels and their SSIM windows; one tile if no pixel has a weight."""
        spans = []
        for axis, length in ((1, camera.height_px), (0, camera.width_px)):
            weighted = np.flatnonzero(pixel_weights.any(axis=axis))
            first, last = (int(weighted[0]), int(weighted[-1])) if len(weighted) else (0, 0)
            spans.append((max(first - _REACH_PX, 0), min(last + 1 + _REACH_PX, length)))
        return cls._between(spans[0], spans[1], camera)

    @classmethod
    def _between(cls, rows: tuple[int, int], columns: tuple[int, int], camera: Camera) -> Window:
        tile_rows, tile_columns = (
            slice(start // TILE_PX, math.ceil(stop / TILE_PX)) for start, stop in (rows, columns)
        )
        return cls(
            tile_rows,
            tile_columns,
            slice(tile_rows.start * TILE_PX, min(tile_rows.stop * TILE_PX, camera.height_px)),
            slice(tile_columns.start * TILE_PX, min(tile_columns.stop * TILE_PX, camera.width_px)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class LossTarget:
    """Target of the loss in a window of a view.

    ssim_terms: means and variances of the target in the SSIM windows. pixel_weights: None means 1 everywhere. share:
    the mean weight of the whole image.
    """

    window: Window
    rgb: Float32[Tensor, "h w 3"]
    depth_m: Float32[Tensor, "h w"]
    ssim_terms: Float32[Tensor, "6 h w"]
    pixel_weights: Float32[Tensor, "h w"] | None
    weight_sum: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class CudaView:
    """A training image on the device: targets of unmasked and of masked steps."""

    camera: Camera
    device_camera: DeviceCamera
    unmasked: LossTarget
    masked: LossTarget

    @classmethod
    def of(
        cls,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        pixel_weights: Float32[ndarray, "h w"] | None,
        device: torch.device,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> CudaView:
        """Copy the images to the device, colours in [0, 1], and compute the constant SSIM terms."""
        colours = to_device(rgb, device).float() / 255.0
        measured_m = to_device(depth_m, device)
        planes = colours.permute(2, 0, 1)
        blurred = _blur(torch.cat([planes, planes * planes]))
        means = blurred[:3]
        ssim_terms = torch.cat([means, blurred[3:] - means * means])
        unmasked = LossTarget(
            window=Window.whole(camera),
            rgb=colours,
            depth_m=measured_m,
            ssim_terms=ssim_terms,
            pixel_weights=None,
            weight_sum=float(depth_m.size),
            share=1.0,
        )
        device_camera = DeviceCamera.of(camera, device, motion, dilation_px2)
        if pixel_weights is None:
            return cls(camera, device_camera, unmasked, unmasked)
        window = Window.around(pixel_weights, camera)
        part, weight_sum = (window.rows, window.columns), float(pixel_weights.sum(dtype=np.float64))
        masked = LossTarget(
            window=window,
            rgb=colours[part],
            depth_m=measured_m[part],
            ssim_terms=ssim_terms[:, window.rows, window.columns],
            pixel_weights=to_device(pixel_weights[part], device),
            weight_sum=weight_sum,
            share=weight_sum / depth_m.size,
        )
        return cls(camera, device_camera, unmasked, masked)


def training_loss(
    channels: Float32[Tensor, "h w 4"], alpha: Float32[Tensor, "h w"], target: LossTarget, loss: LossWeights
) -> Float32[Tensor, ""]:
    """Return the loss of Eq. (2), as defined in LossWeights, on a rendered window that contains all weighted pixels."""
    if target.weight_sum == 0.0:
        return channels.sum() * 0.0
    rgb, depth_m = channels[..., :3], channels[..., 3]
    pixel_weights = torch.ones_like(alpha) if target.pixel_weights is None else target.pixel_weights
    colour = (pixel_weights[..., None] * (rgb - target.rgb).abs()).sum() / 3.0
    # no selection of pixels: the host would wait for their number
    measured = (alpha > MIN_DEPTH_ALPHA) & (target.depth_m > 0)
    error_m = (depth_m / torch.where(measured, alpha, 1.0) - target.depth_m).abs()
    depth = torch.where(measured, pixel_weights * error_m, 0.0).sum()
    total = loss.colour * colour + loss.depth * depth
    if loss.ssim != 0.0:
        total = total - loss.ssim * (pixel_weights * _ssim_sum(rgb, target)).sum() / 3.0
    value = loss.ssim + total / target.weight_sum
    return value * target.share if loss.normalise_by_image else value


def _ssim_sum(rgb: Float32[Tensor, "h w 3"], target: LossTarget) -> Float32[Tensor, "h w"]:
    """Return the SSIM of every pixel, summed over the channels, with zero padding (Wang et al. 2004)."""
    planes, target_planes = rgb.permute(2, 0, 1), target.rgb.permute(2, 0, 1)
    blurred = _blur(torch.cat([planes, planes * planes, planes * target_planes]))
    mean, target_mean, target_variance = blurred[:3], target.ssim_terms[:3], target.ssim_terms[3:]
    variance = blurred[3:6] - mean * mean
    covariance = blurred[6:] - mean * target_mean
    luminance = (2.0 * mean * target_mean + _C1) / (mean * mean + target_mean * target_mean + _C1)
    return (luminance * (2.0 * covariance + _C2) / (variance + target_variance + _C2)).sum(dim=0)


def _blur(planes: Float32[Tensor, "k h w"]) -> Float32[Tensor, "k h w"]:
    """Blur each plane with an 11x11 Gaussian, as two passes of 11 taps.

    The convolution is depthwise, which torch computes in full single precision. An ordinary convolution on a GPU may
    round its factors to ten bits (TF32), which is too coarse for variances.
    """
    offsets = torch.arange(-_REACH_PX, _REACH_PX + 1, dtype=torch.float64, device=planes.device)
    kernel = torch.exp(-offsets.square() / (2.0 * _SIGMA_PX**2))
    kernel = (kernel / kernel.sum()).to(planes.dtype).expand(len(planes), 1, 1, -1)
    lines = conv2d(planes[None], kernel, padding=(0, _REACH_PX), groups=len(planes))
    return conv2d(lines, kernel.transpose(2, 3), padding=(_REACH_PX, 0), groups=len(planes))[0]
