"""Cut boxes out without any network: what stands in the box's middle, as far as its surface goes on without a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.errors import InvalidInputError

_NO_DEPTH: Final = -9.0
_MIDDLE: Final = 0.25


@dataclass(frozen=True, slots=True)
class DepthSegmenterSettings:
    """What is still one surface: neighbours whose depth differs by depth_step (as a share) and colour by colour_step.

    colour_step counts in Lab's units of lightness and hue. It stops at strong edges alone: of depth and colour,
    depth is the one that outlines things. The box is looked at with at most side_px on its longer side.
    """

    depth_step: float = 0.02
    colour_step: float = 20.0
    side_px: int = 96

    def __post_init__(self) -> None:
        for name in ("depth_step", "colour_step"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(
                    f"depth segmenter {name}: expected a positive number, got {getattr(self, name)}"
                )
        if not 8 <= self.side_px <= 4096:
            raise InvalidInputError(f"depth segmenter side_px: expected 8 to 4096, got {self.side_px}")


class DepthSegmenter:
    """A Segmenter by depth and colour: floods each box from its middle."""

    def __init__(self, settings: DepthSegmenterSettings | None = None) -> None:
        self._settings = settings or DepthSegmenterSettings()

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """The largest surface in the middle of each box; None where the middle has no depth."""
        return [self._segment_box(frame, box) for box in boxes_px]

    def _segment_box(self, frame: Frame, box_px: Float32[ndarray, "4"]) -> Bool[ndarray, "h w"] | None:
        height, width = frame.depth_m.shape
        left, top = np.clip(np.floor(box_px[:2]).astype(int), 0, (width, height)).tolist()
        right, bottom = np.clip(np.ceil(box_px[2:]).astype(int), 0, (width, height)).tolist()
        if right <= left or bottom <= top:
            return None
        part = (slice(top, bottom), slice(left, right))
        scale = min(1.0, self._settings.side_px / max(right - left, bottom - top))
        small = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
        depth_m = cv2.resize(frame.depth_m[part], small, interpolation=cv2.INTER_NEAREST)
        rgb = cv2.resize(frame.rgb[part], small, interpolation=cv2.INTER_AREA)
        surface = self._middle_surface(depth_m, rgb)
        if surface is None:
            return None
        closed = cv2.morphologyEx(surface.astype(np.float32), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        mask = np.zeros((height, width), np.bool_)
        mask[part] = cv2.resize(closed, (right - left, bottom - top), interpolation=cv2.INTER_LINEAR) >= 0.5
        return mask

    def _middle_surface(
        self, depth_m: Float32[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]
    ) -> Bool[ndarray, "h w"] | None:
        """Of the surfaces that reach into the middle, the one with most pixels there."""
        layers = _similarity_image(depth_m, rgb)
        step = (self._settings.depth_step, self._settings.colour_step, self._settings.colour_step)
        height, width = depth_m.shape
        middle = np.zeros((height, width), np.bool_)
        inset_y, inset_x = int(height * _MIDDLE), int(width * _MIDDLE)
        middle[inset_y : height - inset_y, inset_x : width - inset_x] = True
        unvisited = middle & (depth_m > 0)
        best, most = None, 0
        while (seeds := np.flatnonzero(unvisited)).size > most:
            y, x = divmod(int(seeds[0]), width)
            flooded = np.zeros((height + 2, width + 2), np.uint8)
            cv2.floodFill(layers, flooded, (x, y), 0, step, step, cv2.FLOODFILL_MASK_ONLY | 4 | (1 << 8))
            surface = flooded[1:-1, 1:-1] > 0
            surface[y, x] = True
            unvisited &= ~surface
            count = int(np.count_nonzero(surface & middle))
            if count > most:
                best, most = surface, count
        return best


def _similarity_image(depth_m: Float32[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
    """What must go on without a step: the logarithm of depth (so that steps are shares), lightness, and hue."""
    lab = cv2.cvtColor(cv2.GaussianBlur(rgb, (3, 3), 0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    log_depth = np.where(depth_m > 0, np.log(np.maximum(depth_m, 1e-3)), _NO_DEPTH)
    stacked = np.dstack([log_depth, lab[..., 0], lab[..., 1] + lab[..., 2]])
    layers: Float32[ndarray, "h w 3"] = np.ascontiguousarray(stacked, np.float32)
    return layers
