"""Segment boxes without a network: flood fill from the box's centre region over continuous depth and colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame

_NO_DEPTH: Final = -9.0


@dataclass(frozen=True, slots=True)
class DepthSegmenterSettings:
    """Largest differences between neighbouring pixels of one surface.

    depth_step: relative difference of depth. colour_step: difference in Lab units; the default stops only at strong
    edges, because depth outlines objects better. side_px: the longer side of the scaled box.
    centre_inset_share: distance of the centre region from each side of the box.
    """

    depth_step: float = 0.02
    colour_step: float = 20.0
    side_px: int = 96
    centre_inset_share: float = 0.25

    def __post_init__(self) -> None:
        for name in ("depth_step", "colour_step"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(
                    f"depth segmenter {name}: expected a positive number, got {getattr(self, name)}"
                )
        if not 8 <= self.side_px <= 4096:
            raise InvalidInputError(f"depth segmenter side_px: expected 8 to 4096, got {self.side_px}")


class DepthSegmenter:
    """A Segmenter that flood-fills depth and colour from the centre region of each box."""

    def __init__(self, settings: DepthSegmenterSettings | None = None) -> None:
        self._settings = settings or DepthSegmenterSettings()

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """Return the largest surface in the centre region of each box; None if that region has no depth."""
        return [self._segment_box(frame, box) for box in boxes_px]

    def grow(self, frame: Frame, seed: tuple[int, int], allowed: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
        """Return the surface around a pixel (row, column), as far as depth and colour are continuous."""
        rows, columns = np.flatnonzero(allowed.any(axis=1)), np.flatnonzero(allowed.any(axis=0))
        window = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
        layers = _similarity_image(np.where(allowed, frame.depth_m, np.float32(0))[window], frame.rgb[window])
        mask = np.zeros(allowed.shape, np.bool_)
        mask[window] = self._flooded(layers, seed[0] - window[0].start, seed[1] - window[1].start)
        return mask

    def _flooded(self, layers: Float32[ndarray, "h w 3"], y: int, x: int) -> Bool[ndarray, "h w"]:
        """Return the pixels that small steps connect with one pixel."""
        step = (self._settings.depth_step, self._settings.colour_step, self._settings.colour_step)
        height, width = layers.shape[:2]
        flooded = np.zeros((height + 2, width + 2), np.uint8)
        flags = cv2.FLOODFILL_MASK_ONLY | 4 | (1 << 8)
        cv2.floodFill(layers, flooded, (x, y), newVal=0, loDiff=step, upDiff=step, flags=flags)
        surface: Bool[ndarray, "h w"] = flooded[1:-1, 1:-1] > 0
        surface[y, x] = True
        return surface

    def _segment_box(self, frame: Frame, box_px: Float32[ndarray, "4"]) -> Bool[ndarray, "h w"] | None:
        height, width = frame.depth_m.shape
        left, top = np.clip(np.floor(box_px[:2]).astype(int), 0, (width, height)).tolist()
        right, bottom = np.clip(np.ceil(box_px[2:]).astype(int), 0, (width, height)).tolist()
        if right <= left or bottom <= top:
            return None
        window = (slice(top, bottom), slice(left, right))
        scale = min(1.0, self._settings.side_px / max(right - left, bottom - top))
        small = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
        depth_m = cv2.resize(frame.depth_m[window], small, interpolation=cv2.INTER_NEAREST)
        rgb = cv2.resize(frame.rgb[window], small, interpolation=cv2.INTER_AREA)
        surface = self._centre_surface(depth_m, rgb)
        if surface is None:
            return None
        closed = cv2.morphologyEx(surface.astype(np.float32), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        mask = np.zeros((height, width), np.bool_)
        mask[window] = cv2.resize(closed, (right - left, bottom - top), interpolation=cv2.INTER_LINEAR) >= 0.5
        return mask

    def _centre_surface(
        self, depth_m: Float32[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]
    ) -> Bool[ndarray, "h w"] | None:
        """Return the surface with the most pixels in the centre region."""
        layers = _similarity_image(depth_m, rgb)
        height, width = depth_m.shape
        centre = np.zeros((height, width), np.bool_)
        inset = self._settings.centre_inset_share
        inset_y, inset_x = int(height * inset), int(width * inset)
        centre[inset_y : height - inset_y, inset_x : width - inset_x] = True
        unvisited = centre & (depth_m > 0)
        best, best_count = None, 0
        while (seeds := np.flatnonzero(unvisited)).size > best_count:
            y, x = divmod(int(seeds[0]), width)
            surface = self._flooded(layers, y, x)
            unvisited &= ~surface
            count = int(np.count_nonzero(surface & centre))
            if count > best_count:
                best, best_count = surface, count
        return best


def _similarity_image(depth_m: Float32[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
    """Return the channels to flood: logarithm of depth (so that steps are relative), lightness, and a + b of Lab."""
    lab = cv2.cvtColor(cv2.GaussianBlur(rgb, (3, 3), 0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    log_depth = np.where(depth_m > 0, np.log(np.maximum(depth_m, 1e-3)), _NO_DEPTH)
    stacked = np.dstack([log_depth, lab[..., 0], lab[..., 1] + lab[..., 2]])
    layers: Float32[ndarray, "h w 3"] = np.ascontiguousarray(stacked, np.float32)
    return layers
