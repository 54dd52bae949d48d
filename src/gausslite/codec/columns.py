"""Quantise the columns of Gaussians. The codes are stable: decoding and encoding again gives the same codes.

| column    | code                                                          | largest error                  |
|-----------|---------------------------------------------------------------|--------------------------------|
| scales_m  | 3 x u8, seven steps per factor of two from 2^-20 m (1 um)     | 5.1 % of the scale             |
| quats     | u8: index of the largest component; 3 x u8: others over it    | depends on scales: `quat_steps`|
| opacities | u8, centres of 64 bins, so never 0 or 1                       | 1/128                          |
| rgb       | 3 x u8: luma in steps of 1/64, two chroma differences in 1/32 | 0.0235 from -0.5 to 1.5        |

A decoder returns the float32 nearest to the code's value.

Positions: a voxel is divided into 2^B cells along each axis, at least so many that a cell is at most half of the
Gaussian's smallest scale. The high bits of a cell's three indices, interleaved, form a Morton code. The Gaussians of a
voxel are sorted by it, so only the differences of these codes are stored; the low bits follow as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import zstandard
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.voxels import VoxelGrid

_ZSTD_LEVEL = 3
_MIN_WINDOW_BYTES = 1 << 10
SCALE_STEPS_PER_OCTAVE = 7
SCALE_MIN_EXPONENT = -20
SCALE_MIN_M = 2.0**SCALE_MIN_EXPONENT
SCALE_MAX_M = 2.0 ** (SCALE_MIN_EXPONENT + 255 / SCALE_STEPS_PER_OCTAVE)
RGB_MIN, RGB_MAX = -0.5, 1.5
OPACITY_BINS = 64
QUAT_ZERO = 128
MAX_QUAT_STEPS = 127
_LUMA_STEPS, _CHROMA_STEPS, _MAX_COLOUR_CODE = 64, 32, 128
_LUMA_MIN, _CHROMA_MIN = RGB_MIN, RGB_MIN - RGB_MAX
_QUAT_PRECISION = 8.0
# the three encoded components, for each index of the largest one
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_SCALES_M = np.exp2(SCALE_MIN_EXPONENT + np.arange(256) / SCALE_STEPS_PER_OCTAVE).astype(np.float32)
_RATIOS = 2.0 ** (np.arange(256) / SCALE_STEPS_PER_OCTAVE)
_STEPS_BY_SPREAD = np.minimum(np.ceil(_QUAT_PRECISION / 2 * (_RATIOS - 1 / _RATIOS)), MAX_QUAT_STEPS).astype(np.int64)
QUAT_STEPS = _STEPS_BY_SPREAD.astype(np.uint8).tobytes()
"""The steps by the difference between the largest and the smallest code of a scale, a byte each."""
MAX_FINE_BITS = 15
MIN_COARSE_BITS, MAX_COARSE_BITS = 2, 5
_CELL_SHARE = 0.5
# the centre of a cell of MAX_FINE_BITS is an odd number of these parts
_FRACTIONS = 1 << (MAX_FINE_BITS + 1)


def pack_bits(values: Int64[ndarray, " n"], widths: Int64[ndarray, " n"]) -> bytes:
    """Return the low widths[i] bits of values[i], one value after the other; the last byte is filled with zeros."""
    bit_indices = np.arange(int(widths.max(initial=0)))
    bits = (values[:, None] >> bit_indices & 1).astype(np.uint8)
    return np.packbits(bits[bit_indices < widths[:, None]], bitorder="little").tobytes()


@dataclass(frozen=True, slots=True)
class Column:
    """Type, such as <u4, and shape of an array in a frame."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def byte_count(self) -> int:
        """Bytes before compression."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


def compress_columns(arrays: Sequence[NDArray[Any]], columns: Sequence[Column]) -> bytes:
    """Return the frame. The bytes of a column are shuffled: all first bytes, then all second bytes, and so on."""
    packed = [
        _shuffle(np.ascontiguousarray(array, column.dtype)) for array, column in zip(arrays, columns, strict=True)
    ]
    compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compressobj(size=sum(map(len, packed)))
    parts = []
    for column_bytes in packed:
        parts += [compressor.compress(column_bytes), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*parts, compressor.flush()])


def decompress_columns(frame: bytes, columns: Sequence[Column]) -> list[NDArray[Any]]:
    """Return the arrays. Raises CodecError, before memory is allocated, if the frame declares another size."""
    ends = list(accumulate(column.byte_count for column in columns))
    raw = decompress(frame, ends[-1])
    return [_unshuffle(raw[end - column.byte_count : end], column) for column, end in zip(columns, ends, strict=True)]


def decompress(frame: bytes, size: int) -> bytes:
    """Return the content of a frame. Raises CodecError, before memory is allocated, if it declares another size."""
    try:
        header = zstandard.get_frame_parameters(frame)
        if header.content_size != size or header.window_size > max(size, _MIN_WINDOW_BYTES):
            raise CodecError(f"subset: expected a body of {size} bytes, got {header.content_size}")
        raw: bytes = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(f"subset: body is not one zstd frame: {error}") from error
    return raw


def _shuffle(array: NDArray[Any]) -> bytes:
    return array.view(np.uint8).reshape(-1, array.itemsize).T.tobytes()


def _unshuffle(raw: bytes, column: Column) -> NDArray[Any]:
    planes = np.frombuffer(raw, np.uint8).reshape(np.dtype(column.dtype).itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).view(column.dtype).reshape(column.shape)


def encode_scales(scales_m: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode scales on a logarithmic grid, clamped to SCALE_MIN_M and SCALE_MAX_M."""
    octaves = np.log2(np.clip(scales_m.astype(np.float64), SCALE_MIN_M, SCALE_MAX_M)) - SCALE_MIN_EXPONENT
    return np.asarray(np.rint(octaves * SCALE_STEPS_PER_OCTAVE), np.uint8)


def decode_scales(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode scales in metres."""
    return np.asarray(_SCALES_M[codes])


def quat_steps(scale_codes: UInt8[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return the steps of a quaternion's components: a long Gaussian needs more than a round one, which needs none.

    A rotation by t changes the covariance, relative to the product of two scales of ratio r, by t * (r - 1/r). The
    steps grow with r - 1/r, up to 127, so that this change is at most 0.25 for ratios up to 32.
    """
    # NumPy reduces three long rows much faster than many short ones
    axes = np.ascontiguousarray(scale_codes.T)
    return np.asarray(_STEPS_BY_SPREAD[axes.max(axis=0) - axes.min(axis=0)])


def encode_quats(
    quats_wxyz: Float32[ndarray, "n 4"], steps: Int64[ndarray, " n"]
) -> tuple[UInt8[ndarray, " n"], UInt8[ndarray, "n 3"]]:
    """Return the index of the largest component, and the other three over it in these steps, plus 128."""
    exact = quats_wxyz.astype(np.float64)
    codes = np.rint(exact * (steps / np.ascontiguousarray(np.abs(exact).T).max(axis=0))[:, None]).astype(np.int64)
    # q and -q are one rotation, so the largest component is made positive; ties use the quantised values
    rows = np.arange(len(codes))
    largest = np.abs(codes).argmax(axis=1)
    codes *= np.sign(codes[rows, largest])[:, None]
    others = codes[rows[:, None], _OTHERS[largest]] + QUAT_ZERO
    return largest.astype(np.uint8), others.astype(np.uint8)


def decode_quats(
    largest: UInt8[ndarray, " n"], others: UInt8[ndarray, "n 3"], steps: Int64[ndarray, " n"]
) -> Float32[ndarray, "n 4"]:
    """Decode unit quaternions w x y z."""
    offsets = others.astype(np.int64) - QUAT_ZERO
    full = np.empty((len(steps), 4))
    rows = np.arange(len(steps))
    # a round Gaussian has no steps and no rotation
    full[rows, largest] = np.maximum(steps, 1)
    full[rows[:, None], _OTHERS[largest]] = offsets
    return np.asarray(full / np.linalg.norm(full, axis=1, keepdims=True), np.float32)


def encode_opacities(opacities: Float32[ndarray, " n"]) -> UInt8[ndarray, " n"]:
    """Encode opacities in equal bins."""
    return np.clip(np.floor(opacities.astype(np.float64) * OPACITY_BINS), 0, OPACITY_BINS - 1).astype(np.uint8)


def decode_opacities(codes: UInt8[ndarray, " n"]) -> Float32[ndarray, " n"]:
    """Decode opacities as the centres of the bins."""
    return ((codes.astype(np.float64) + 0.5) / OPACITY_BINS).astype(np.float32)


def encode_rgb(rgb: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode colours as luma and two differences (YCoCg), each clamped; trained colours exceed 0 to 1."""
    red, green, blue = rgb.astype(np.float64).T
    orange = red - blue
    middle = blue + orange / 2
    lime = green - middle
    luma = (middle + lime / 2 - _LUMA_MIN) * _LUMA_STEPS
    codes = np.stack([luma, *((chroma - _CHROMA_MIN) * _CHROMA_STEPS for chroma in (orange, lime))], axis=1)
    return np.asarray(np.clip(np.rint(codes), 0, _MAX_COLOUR_CODE), np.uint8)


def decode_rgb(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode colours."""
    luma = _LUMA_MIN + codes[:, 0] / _LUMA_STEPS
    orange, lime = (_CHROMA_MIN + codes[:, i] / _CHROMA_STEPS for i in (1, 2))
    middle = luma - lime / 2
    blue = middle - orange / 2
    return np.stack([blue + orange, middle + lime, blue], axis=1).astype(np.float32)


class PositionPrecision(NamedTuple):
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
        return np.asarray(np.clip(bits, self.coarse_bits, MAX_FINE_BITS))


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
    return np.clip(cells, 0, counts - 1).astype(np.int64)


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
