"""Quantise the columns of Gaussians. The codes are stable: decoding and encoding again gives the same bytes.

| column    | code                                                  | largest error                                   |
|-----------|-------------------------------------------------------|-------------------------------------------------|
| means_m   | 3 x u16 across the voxel                              | half of size/65535, and float32's own rounding  |
| scales_m  | 3 x u8, logarithmic from 0.1 mm to 20 m, clamped      | 2.5 % of the scale                              |
| quats     | u32: which component is largest, the others over it   | 0.25 degrees                                    |
| opacities | u8, centres of 256 bins, so never 0 or 1              | 1/512                                           |
| rgb       | 3 x u8 from -0.25 to 1.25, clamped                    | 0.003                                           |

Each decoder returns the valid float32 nearest to the code's grid value. The original was valid too, so the decoded
value is never farther from the grid value than the original, and gets the same code.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64, UInt8, UInt16, UInt32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import VoxelGrid

MEAN_STEPS = 65535
SCALE_MIN_M, SCALE_MAX_M = 1e-4, 20.0
RGB_MIN, RGB_MAX = -0.25, 1.25
QUAT_STEPS = 511

_LOG_MIN = float(np.log(SCALE_MIN_M))
_LOG_STEP = (float(np.log(SCALE_MAX_M)) - _LOG_MIN) / 255
_RGB_STEP = (RGB_MAX - RGB_MIN) / 255
# the three encoded components, for each index of the largest one
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def encode_means(
    means_m: Float32[ndarray, "n 3"], voxel: Int64[ndarray, "n 3"], grid: VoxelGrid
) -> UInt16[ndarray, "n 3"]:
    """Encode means as steps across their voxels. Raises InvalidInputError if a mean is outside its voxel."""
    exact = means_m.astype(np.float64)
    if not np.array_equal(np.floor(exact / grid.size_m), voxel.astype(np.float64)):
        raise InvalidInputError("voxel batch means_m: expected every mean inside its voxel, got one outside")
    steps = np.rint((exact - voxel * grid.size_m) * (MEAN_STEPS / grid.size_m))
    return np.clip(steps, 0, MEAN_STEPS).astype(np.uint16)


def decode_means(
    steps: UInt16[ndarray, "n 3"], voxel: Int64[ndarray, "n 3"], grid: VoxelGrid
) -> Float32[ndarray, "n 3"]:
    """Decode means: the float32 points inside the voxels that are nearest to the steps."""
    means_m = (voxel * grid.size_m + steps.astype(np.float64) * (grid.size_m / MEAN_STEPS)).astype(np.float32)
    # rounding to float32 can cross a voxel's face by one float
    index = np.floor(means_m.astype(np.float64) / grid.size_m)
    means_m = np.where(index < voxel, np.nextafter(means_m, np.float32(np.inf)), means_m)
    return np.where(index > voxel, np.nextafter(means_m, np.float32(-np.inf)), means_m)


def encode_scales(scales_m: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode scales on a logarithmic grid."""
    logs = np.log(np.clip(scales_m.astype(np.float64), SCALE_MIN_M, SCALE_MAX_M))
    return np.rint((logs - _LOG_MIN) / _LOG_STEP).astype(np.uint8)


def decode_scales(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode scales in metres."""
    scales_m: Float32[ndarray, "n 3"] = np.exp(_LOG_MIN + codes.astype(np.float64) * _LOG_STEP).astype(np.float32)
    return scales_m


def encode_quats(quats_wxyz: Float32[ndarray, "n 4"]) -> UInt32[ndarray, " n"]:
    """Encode the index of the largest component (2 bits) and the other three divided by it (10 bits each)."""
    exact = quats_wxyz.astype(np.float64)
    steps = np.rint(exact * (QUAT_STEPS / np.abs(exact).max(axis=1, keepdims=True))).astype(np.int64)
    # q and -q are one rotation, so the largest component is made positive; ties use the quantised values
    rows = np.arange(len(steps))
    largest = np.abs(steps).argmax(axis=1)
    steps *= np.sign(steps[rows, largest])[:, None]
    others = steps[rows[:, None], _OTHERS[largest]] + QUAT_STEPS
    packed = (largest << 30) | (others[:, 0] << 20) | (others[:, 1] << 10) | others[:, 2]
    codes: UInt32[ndarray, " n"] = packed.astype(np.uint32)
    return codes


def decode_quats(codes: UInt32[ndarray, " n"]) -> Float32[ndarray, "n 4"]:
    """Decode unit quaternions w x y z."""
    wide = codes.astype(np.int64)
    largest = wide >> 30
    others = np.stack([(wide >> shift) & 1023 for shift in (20, 10, 0)], axis=1) - QUAT_STEPS
    steps = np.full((len(wide), 4), float(QUAT_STEPS))
    steps[np.arange(len(wide))[:, None], _OTHERS[largest]] = others
    quats_wxyz: Float32[ndarray, "n 4"] = (steps / np.linalg.norm(steps, axis=1, keepdims=True)).astype(np.float32)
    return quats_wxyz


def encode_opacities(opacities: Float32[ndarray, " n"]) -> UInt8[ndarray, " n"]:
    """Encode opacities in 256 equal bins."""
    return np.clip(np.floor(opacities.astype(np.float64) * 256), 0, 255).astype(np.uint8)


def decode_opacities(codes: UInt8[ndarray, " n"]) -> Float32[ndarray, " n"]:
    """Decode opacities as the centres of the bins."""
    return ((codes.astype(np.float64) + 0.5) / 256).astype(np.float32)


def encode_rgb(rgb: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode colours; the range exceeds 0 to 1, because trained colours do."""
    return np.rint((np.clip(rgb.astype(np.float64), RGB_MIN, RGB_MAX) - RGB_MIN) / _RGB_STEP).astype(np.uint8)


def decode_rgb(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode colours; black and white are exact to half a step."""
    return (RGB_MIN + codes.astype(np.float64) * _RGB_STEP).astype(np.float32)
