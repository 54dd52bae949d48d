"""Prepare a keyframe for training: its images, the tiles of its region, its pixel weights (Sec. III-D.1)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.frame import Frame, without_depth_edges
from gausslite.domain.pose import inverse
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import TILE_PX, Rasterizer, Subset, TrainingView, reduced_dilation_px2

_ROI_MARGIN_PX = 5
"""Margin around the ROI within which tiles are rendered in the active phase: SSIM's window needs it."""
_SSIM_WINDOW_PX = 11
_ALL_MEASURED = 0.999


@dataclass(frozen=True, slots=True, eq=False)
class WindowView:
    """A keyframe prepared for training."""

    keyframe: Keyframe
    training_view: TrainingView  # prepared by the rasterizer, whole or masked to the ROI's tiles
    image_view: TrainingView  # for iterations on whole images; has weights if the frame leaves out pixels
    is_half_size: bool  # image_view
    T_camera_world: Float64[ndarray, "4 4"]
    roi: Subset  # the 16x16 tiles that touch the ROI or its margin

    @property
    def shows_roi(self) -> bool:
        """True if a pixel belongs to the ROI."""
        return self.roi.tiles is not None and bool(self.roi.tiles.any())

    @property
    def roi_share(self) -> float:
        """Share of the image's tiles that the active phase renders."""
        return 1.0 if self.roi.tiles is None else float(self.roi.tiles.mean())


def window_view(keyframe: Keyframe, rasterizer: Rasterizer, settings: KeyframeSettings) -> WindowView:
    """Prepare a keyframe for training. The margin gives the SSIM window its neighbours at the ROI's border."""
    frame = keyframe.frame
    tiles, pixel_weights = roi_weights(keyframe.relevance.pixel_weights, settings.roi_context_weight)
    depth_m = without_depth_edges(frame.depth_m, settings.depth_edge_px)
    trained = None if frame.left_out is None else _with_whole_windows(~frame.left_out)
    if trained is not None:
        pixel_weights = pixel_weights * trained  # the context has weights there too
    view = image_view = rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, pixel_weights, frame.motion)
    is_half_size = depth_m.size >= settings.half_size_from_px
    if is_half_size:
        image_view = _half_view(frame, depth_m, rasterizer)
    elif trained is not None:
        image_view = rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, trained, frame.motion)
    return WindowView(keyframe, view, image_view, is_half_size, inverse(frame.T_world_camera), Subset(tiles))


def _half_view(frame: Frame, depth_m: Float32[ndarray, "h w"], rasterizer: Rasterizer) -> TrainingView:
    """Prepare the image in half size: colours averaged over 2x2 pixels, depths too where all four are measured."""
    width, height = frame.camera.width_px // 2, frame.camera.height_px // 2

    def halved(image: ndarray) -> ndarray:
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    # a mean with an unmeasured pixel would be too near
    halved_m = np.where(halved((depth_m > 0).astype(np.float32)) > _ALL_MEASURED, halved(depth_m), np.float32(0.0))
    left_out = None if frame.left_out is None else halved(frame.left_out.astype(np.float32))
    weights = None if left_out is None else _with_whole_windows(left_out == 0)
    camera = frame.camera.resized(width, height)
    return rasterizer.prepare_view(
        halved(frame.rgb), halved_m, camera, weights, frame.motion, reduced_dilation_px2(2.0)
    )


def roi_weights(
    pixel_weights: Float32[ndarray, "h w"], context_weight: float
) -> tuple[Bool[ndarray, "th tw"], Float32[ndarray, "h w"]]:
    """Return the tiles of the pixels with a weight, and the weights with those of the other pixels inside the tiles."""
    tiles = tiles_touching(pixel_weights > 0, _ROI_MARGIN_PX)
    if context_weight > 0:
        # neighbours would drift into the region
        context = np.float32(context_weight) * _pixels_inside(tiles, pixel_weights.shape)
        pixel_weights = np.maximum(pixel_weights, context)
    return tiles, pixel_weights


def tiles_touching(mask: Bool[ndarray, "h w"], margin_px: int) -> Bool[ndarray, "th tw"]:
    """Return the 16x16 tiles that touch the mask dilated by margin_px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    dilated = cv2.dilate(mask.view(np.uint8), kernel)
    height, width = mask.shape
    padded = np.pad(dilated, ((0, -height % TILE_PX), (0, -width % TILE_PX)))
    by_rows = padded.reshape(-1, TILE_PX, padded.shape[1]).max(axis=1)
    tiles: Bool[ndarray, "th tw"] = by_rows.reshape(len(by_rows), -1, TILE_PX).any(axis=2)
    return tiles


def _pixels_inside(tiles: Bool[ndarray, "th tw"], shape: tuple[int, ...]) -> Float32[ndarray, "h w"]:
    """Return 1 where the whole SSIM window lies in these tiles, else 0; outside them nothing is rendered."""
    rendered = np.repeat(np.repeat(tiles, TILE_PX, axis=0), TILE_PX, axis=1)[: shape[0], : shape[1]]
    return _with_whole_windows(rendered)


def _with_whole_windows(pixels: Bool[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return 1 for pixels whose whole SSIM window lies in these pixels, else 0."""
    return cv2.erode(pixels.astype(np.float32), np.ones((_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), np.uint8))
