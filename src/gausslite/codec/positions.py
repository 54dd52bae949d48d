"""Encode the positions of Gaussians in their voxels, with a precision that follows from each Gaussian's own scales.

A voxel is divided into 2^B cells along each axis, at least so many that a cell is at most half of the Gaussian's
smallest scale. The high bits of a cell's three indices, interleaved, form a Morton code. The Gaussians of a voxel are
sorted by it, so only the differences of these codes are stored; the low bits follow as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.bit_fields import pack_bits, unpack_bits
from gausslite.codec.columns import SCALE_MIN_EXPONENT, SCALE_STEPS_PER_OCTAVE
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.voxels import VoxelGrid

MAX_FINE_BITS = 15
MIN_COARSE_BITS, MAX_COARSE_BITS = 2, 5
_CELL_SHARE = 0.5
# the centre of a cell of MAX_FINE_BITS is an odd number of these parts
_FRACTIONS = 1 << (MAX_FINE_BITS + 1)


@dataclass(frozen=True, slots=True)
class PositionPrecision:
    """Bits per axis of the positions of a message.

    coarse_bits: those of the Morton code. scale_code: code of the scale that equals two voxels; a Gaussian whose
    smallest scale has code c gets ceil((scale_code - c) / 7) bits, at least the coarse ones.
    """

    coarse_bits: int
    scale_code: int

    @classmethod
    def of(cls, gaussians: int, voxels: int, grid: VoxelGrid) -> PositionPrecision:
        """Return the precision for so many Gaussians in so many voxels: more coarse bits in fuller voxels."""
        mean = max(gaussians, 1) / max(voxels, 1)
        coarse = min(max(round(1.8 + math.log2(mean) / 2), MIN_COARSE_BITS), MAX_COARSE_BITS)
        scale_code = math.ceil((math.log2(grid.size_m / _CELL_SHARE) - SCALE_MIN_EXPONENT) * SCALE_STEPS_PER_OCTAVE)
        return cls(coarse, scale_code)

    def bits(self, scale_codes: UInt8[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
        """Return the bits per axis of each Gaussian's position."""
        smallest = np.ascontiguousarray(scale_codes.T).min(axis=0).astype(np.int64)
        bits = -((smallest - self.scale_code) // SCALE_STEPS_PER_OCTAVE)
        clipped: Int64[ndarray, " n"] = np.clip(bits, self.coarse_bits, MAX_FINE_BITS)
        return clipped


def cells_of(
    means_m: Float32[ndarray, "n 3"], voxel: Int64[ndarray, "n 3"], bits: Int64[ndarray, " n"], grid: VoxelGrid
) -> Int64[ndarray, "n 3"]:
    """Return the cell of each mean in its voxel. Raises InvalidInputError if a mean is outside its voxel."""
    exact = means_m.astype(np.float64)
    if not np.array_equal(np.floor(exact / grid.size_m), voxel.astype(np.float64)):
        raise InvalidInputError("voxel batch means_m: expected every mean inside its voxel, got one outside")
    counts = (np.int64(1) << bits)[:, None]
    # rounding to even makes the code stable where float32 has only the faces of the cell
    cells = np.rint((exact - voxel * grid.size_m) * (counts / grid.size_m) - 0.5)
    clipped: Int64[ndarray, "n 3"] = np.clip(cells, 0, counts - 1).astype(np.int64)
    return clipped


def centres_of(
    cells: Int64[ndarray, "n 3"], voxel: Int64[ndarray, "n 3"], bits: Int64[ndarray, " n"], grid: VoxelGrid
) -> Float32[ndarray, "n 3"]:
    """Return the float32 points inside the voxels that are nearest to the cells' centres."""
    return points_of((2 * cells + 1) << (MAX_FINE_BITS - bits)[:, None], voxel, grid)


def fractions_of(
    means_m: Float32[ndarray, "n 3"], voxel: Int64[ndarray, "n 3"], grid: VoxelGrid
) -> Int64[ndarray, "n 3"]:
    """Return the place of each mean in its voxel in 65536ths of the voxel's size; every cell's centre has one."""
    offsets_m = means_m.astype(np.float64) - voxel * grid.size_m
    fractions: Int64[ndarray, "n 3"] = np.clip(
        np.rint(offsets_m * (_FRACTIONS / grid.size_m)), 0, _FRACTIONS - 1
    ).astype(np.int64)
    return fractions


def points_of(
    fractions: NDArray[np.integer[Any]], voxel: Int64[ndarray, "n 3"], grid: VoxelGrid
) -> Float32[ndarray, "n 3"]:
    """Return the float32 points inside the voxels that are nearest to these fractions."""
    means_m = (voxel * grid.size_m + fractions * (grid.size_m / _FRACTIONS)).astype(np.float32)
    # rounding to float32 can cross a voxel's face by one float
    index = np.floor(means_m.astype(np.float64) / grid.size_m)
    means_m = np.where(index < voxel, np.nextafter(means_m, np.float32(np.inf)), means_m)
    return np.where(index > voxel, np.nextafter(means_m, np.float32(-np.inf)), means_m)


def morton_codes(cells: Int64[ndarray, "n 3"], bits: Int64[ndarray, " n"], coarse_bits: int) -> Int64[ndarray, " n"]:
    """Return the interleaved high bits of the cells' indices; x has the highest of three bits."""
    coarse = cells >> (bits - coarse_bits)[:, None]
    codes = np.zeros(len(cells), np.int64)
    for place in range(coarse_bits):
        for axis in range(3):
            codes |= (coarse[:, axis] >> place & 1) << (3 * place + 2 - axis)
    return codes


def encode_positions(
    cells: Int64[ndarray, "n 3"], codes: Int64[ndarray, " n"], bits: Int64[ndarray, " n"], starts: Int64[ndarray, " v"],
    coarse_bits: int,
) -> tuple[UInt8[ndarray, " n"], bytes]:  # fmt: skip
    """Return the bit length of each difference of Morton codes, and all other bits packed.

    The codes ascend within a voxel; starts are the rows at which the voxels begin.
    """
    deltas = np.diff(codes, prepend=0)
    deltas[starts] = codes[starts]
    lengths = np.ceil(np.log2(deltas + 1)).astype(np.int64)
    fine = bits - coarse_bits
    low = cells & ((np.int64(1) << fine) - 1)[:, None]
    widths = np.concatenate([np.maximum(lengths - 1, 0), fine, fine, fine])
    return lengths.astype(np.uint8), pack_bits(np.concatenate([deltas, *low.T]), widths)


def decode_positions(
    lengths: UInt8[ndarray, " n"], packed: bytes, bits: Int64[ndarray, " n"], starts: Int64[ndarray, " v"],
    coarse_bits: int,
) -> Int64[ndarray, "n 3"]:  # fmt: skip
    """Return the cells. Raises CodecError for a Morton code out of range and other sizes of the packed bits."""
    n, wide = len(lengths), lengths.astype(np.int64)
    if (wide > 3 * coarse_bits).any():
        raise CodecError(f"subset positions: expected differences of up to {3 * coarse_bits} bits, got a longer one")
    fine = bits - coarse_bits
    values = unpack_bits(packed, np.concatenate([np.maximum(wide - 1, 0), fine, fine, fine]))
    # the highest bit of a difference is always one, so it is not stored
    deltas = values[:n] | (np.int64(1) << wide) >> 1
    totals = np.concatenate([np.zeros(1, np.int64), np.cumsum(deltas)])
    codes = totals[1:] - np.repeat(totals[starts], np.diff(starts, append=n))
    if (codes >> 3 * coarse_bits).any():
        raise CodecError("subset positions: expected cells inside their voxels, got one outside")
    cells: Int64[ndarray, "n 3"] = values[n:].reshape(3, n).T | _COARSE_CELLS[codes] << fine[:, None]
    return cells


def _coarse_cells() -> Int64[ndarray, "c 3"]:
    """Return the three indices that each Morton code interleaves."""
    codes = np.arange(1 << 3 * MAX_COARSE_BITS)
    cells = np.zeros((len(codes), 3), np.int64)
    for place in range(MAX_COARSE_BITS):
        for axis in range(3):
            cells[:, axis] |= (codes >> (3 * place + 2 - axis) & 1) << place
    return cells


_COARSE_CELLS = _coarse_cells()
