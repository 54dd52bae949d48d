"""Texture atlas with mip levels: a whole view is textured with two look-ups."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray

from gausslite_sim.textures import SIDE_PX, Texture

_LEVELS = 7
_MARGIN_PX = 2
_ROW_PX = 512
_SHARPNESS = 0.4
"""Mip level bias towards finer levels: a camera's lens blurs less than one pixel."""


class TextureAtlas:
    """Textures in a grid: the finest level on the left, coarser levels stacked to its right, with wrapped margins."""

    def __init__(self, textures: Sequence[Texture]) -> None:
        self._columns = int(np.ceil(np.sqrt(len(textures))))
        self._rows = -(-len(textures) // self._columns)
        self._sides = np.array([SIDE_PX >> level for level in range(_LEVELS)], np.float32)
        pitches = [(SIDE_PX >> level) + 2 * _MARGIN_PX for level in range(_LEVELS)]
        tops = [0, *np.cumsum([0, *(pitch * self._rows for pitch in pitches[1:-1])])]
        self._lefts = np.array([0] + [pitches[0] * self._columns] * (_LEVELS - 1), np.float32)
        self._tops = np.array(tops, np.float32)
        self._pitches = np.array(pitches, np.float32)
        height = max(pitches[0] * self._rows, int(tops[-1]) + pitches[-1] * self._rows)
        self._image = np.zeros((height, (pitches[0] + pitches[1]) * self._columns, 3), np.uint8)
        for i, texture in enumerate(textures):
            self._place(i, texture.rgb)

    def sample(
        self,
        texture: Int64[ndarray, " n"],
        uv: Float32[ndarray, "n 2"],
        texels_per_pixel: Float32[ndarray, " n"],
    ) -> Float32[ndarray, "n 3"]:
        """Return colours 0 to 255 at texture coordinates (1 = one repeat), filtered to the pixel's footprint."""
        level = np.clip(np.log2(np.maximum(texels_per_pixel, 1e-6)) - _SHARPNESS, 0, _LEVELS - 1.001)
        fine = level.astype(np.int64)
        share = (level - fine).astype(np.float32)[:, None]
        wrapped = uv - np.floor(uv)
        low, high = self._look_up(texture, wrapped, fine), self._look_up(texture, wrapped, fine + 1)
        blended: Float32[ndarray, "n 3"] = low + share * (high - low)
        return blended

    def _look_up(
        self, texture: Int64[ndarray, " n"], wrapped: Float32[ndarray, "n 2"], level: Int64[ndarray, " n"]
    ) -> Float32[ndarray, "n 3"]:
        n = len(texture)
        row, column = np.divmod(texture, self._columns)
        pitch, side = self._pitches[level], self._sides[level]
        offset = np.float32(_MARGIN_PX - 0.5)
        # cv2.remap limits the image width, so the points are arranged in rows
        grid = np.zeros((2, -(-n // _ROW_PX) * _ROW_PX), np.float32)
        grid[0, :n] = self._lefts[level] + column.astype(np.float32) * pitch + wrapped[:, 0] * side + offset
        grid[1, :n] = self._tops[level] + row.astype(np.float32) * pitch + wrapped[:, 1] * side + offset
        x, y = grid.reshape(2, -1, _ROW_PX)
        colours = cv2.remap(self._image, x, y, cv2.INTER_LINEAR)
        return colours.reshape(-1, 3)[:n].astype(np.float32)

    def _place(self, i: int, rgb: UInt8[ndarray, "s s 3"]) -> None:
        row, column = divmod(i, self._columns)
        for level in range(_LEVELS):
            side = SIDE_PX >> level
            small = rgb if level == 0 else cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA)
            margin = ((_MARGIN_PX, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (0, 0))
            pitch = int(self._pitches[level])
            top, left = int(self._tops[level]) + row * pitch, int(self._lefts[level]) + column * pitch
            self._image[top : top + pitch, left : left + pitch] = np.pad(small, margin, mode="wrap")
