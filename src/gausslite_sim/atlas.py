"""Texture atlas with mip levels, and means over the footprints of pixels."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray

from gausslite_sim.textures import SIDE_PX, Texture

_LEVELS = 7
_MARGIN_PX = 2
_SHARPNESS = 0.4
"""Mip level bias towards finer levels: interpolation blurs more than the mean over a square does."""
_MAX_TAPS_LOG2 = 5
_PLAIN, _PLAIN_TAPS = 16.0, 1 / 3
"""A texture whose finest and coarsest levels differ by less (root mean square, of 255) needs this share of taps."""
_CHUNK = 2048
"""Footprints of one look-up: its coordinates stay in the processor's cache."""


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
        self._taps = np.ones(len(textures), np.float32)
        self._image = np.zeros((height, (pitches[0] + pitches[1]) * self._columns, 3), np.uint8)
        for i, texture in enumerate(textures):
            self._place(i, texture.rgb)

    def mean(
        self,
        texture: Int64[ndarray, " n"],
        uv: Float32[ndarray, "n 2"],
        sides: Float32[ndarray, "2 n 2"],
        taps: int,
    ) -> Float32[ndarray, "n 3"]:
        """Return mean colours 0 to 255 over parallelograms round these texture coordinates, with these sides.

        taps: least number of look-ups along the shorter side, if that is longer than so many texels; plain textures
        need fewer.
        """
        across, down = sides
        widths, heights = SIDE_PX * np.hypot(sides[..., 0], sides[..., 1])
        cells = np.maximum(np.minimum(widths, heights) / (taps * self._taps[texture]), 1.0)
        counts_log2 = [
            np.clip(np.ceil(np.log2(np.maximum(lengths / cells, 0.5)) - 0.25), 0, _MAX_TAPS_LOG2).astype(np.int64)
            for lengths in (widths, heights)
        ]
        areas = np.maximum(widths * heights / 2.0 ** (counts_log2[0] + counts_log2[1]), 1e-6)
        level = np.clip(np.rint(0.5 * np.log2(areas) - _SHARPNESS), 0, _LEVELS - 1).astype(np.int64)
        origins, scale = self._origins(texture, level), self._sides[level]
        means = np.empty((len(texture), 3), np.float32)
        shapes = counts_log2[0] * (_MAX_TAPS_LOG2 + 1) + counts_log2[1]
        for shape in np.unique(shapes):
            selected = np.flatnonzero(shapes == shape)
            places = _tap_grid(*divmod(int(shape), _MAX_TAPS_LOG2 + 1))
            for part in np.array_split(selected, -(-len(selected) // _CHUNK)):
                positions = []
                for axis in (0, 1):
                    at = uv[part, axis] + places[0] * across[part, axis] + places[1] * down[part, axis]
                    at -= np.floor(at)
                    at *= scale[part]
                    at += origins[axis][part]
                    positions.append(at)
                colours = cv2.remap(self._image, positions[0], positions[1], cv2.INTER_LINEAR)
                means[part] = colours.sum(axis=0, dtype=np.uint32) / np.float32(len(colours))
        return means

    def _origins(
        self, texture: Int64[ndarray, " n"], level: Int64[ndarray, " n"]
    ) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
        """Return the column and row in the atlas of each texture's corner at its mip level."""
        row, column = np.divmod(texture, self._columns)
        pitch, offset = self._pitches[level], np.float32(_MARGIN_PX - 0.5)
        x = self._lefts[level] + column.astype(np.float32) * pitch + offset
        return x, self._tops[level] + row.astype(np.float32) * pitch + offset

    def _place(self, i: int, rgb: UInt8[ndarray, "s s 3"]) -> None:
        row, column = divmod(i, self._columns)
        coarse = cv2.resize(rgb, (SIDE_PX >> (_LEVELS - 1),) * 2, interpolation=cv2.INTER_AREA)
        fine = cv2.resize(coarse, (SIDE_PX, SIDE_PX)).astype(np.float32)
        if np.square(rgb - fine).mean() < _PLAIN**2:
            self._taps[i] = _PLAIN_TAPS
        for level in range(_LEVELS):
            side = SIDE_PX >> level
            small = rgb if level == 0 else cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA)
            margin = ((_MARGIN_PX, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (0, 0))
            pitch = int(self._pitches[level])
            top, left = int(self._tops[level]) + row * pitch, int(self._lefts[level]) + column * pitch
            self._image[top : top + pitch, left : left + pitch] = np.pad(small, margin, mode="wrap")


def _tap_grid(across_log2: int, down_log2: int) -> Float32[ndarray, "2 k 1"]:
    """Return the places of a footprint's look-ups, in shares of its sides from its centre."""
    across, down = ((np.arange(1 << count) + 0.5) / (1 << count) - 0.5 for count in (across_log2, down_log2))
    grid = np.stack(np.meshgrid(across, down), axis=0).reshape(2, -1, 1)
    return grid.astype(np.float32)
