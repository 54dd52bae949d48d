"""Quantise the columns of Gaussians. The codes are stable: decoding and encoding again gives the same codes.

| column    | code                                                          | largest error                  |
|-----------|---------------------------------------------------------------|--------------------------------|
| scales_m  | 3 x u8, seven steps per factor of two from 2^-20 m (1 um)     | 5.1 % of the scale             |
| quats     | u8: index of the largest component; 3 x u8: others over it    | depends on scales: `quat_steps`|
| opacities | u8, centres of 64 bins, so never 0 or 1                       | 1/128                          |
| rgb       | 3 x u8: luma in steps of 1/64, two chroma differences in 1/32 | 0.0235 from -0.5 to 1.5        |

`positions.py` has the means. A decoder returns the float32 nearest to the code's value.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import CodecError

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


def encode_scales(scales_m: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode scales on a logarithmic grid, clamped to SCALE_MIN_M and SCALE_MAX_M."""
    octaves = np.log2(np.clip(scales_m.astype(np.float64), SCALE_MIN_M, SCALE_MAX_M)) - SCALE_MIN_EXPONENT
    codes: UInt8[ndarray, "n 3"] = np.rint(octaves * SCALE_STEPS_PER_OCTAVE).astype(np.uint8)
    return codes


def decode_scales(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode scales in metres."""
    scales_m: Float32[ndarray, "n 3"] = _SCALES_M[codes]
    return scales_m


_SCALES_M = np.exp2(SCALE_MIN_EXPONENT + np.arange(256) / SCALE_STEPS_PER_OCTAVE).astype(np.float32)


def quat_steps(scale_codes: UInt8[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return the steps of a quaternion's components: a long Gaussian needs more than a round one, which needs none.

    A rotation by t changes the covariance, relative to the product of two scales of ratio r, by t * (r - 1/r). The
    steps grow with r - 1/r, up to 127, so that this change is at most 0.25 for ratios up to 32.
    """
    # NumPy reduces three long rows much faster than many short ones
    axes = np.ascontiguousarray(scale_codes.T)
    steps: Int64[ndarray, " n"] = _STEPS_BY_SPREAD[axes.max(axis=0) - axes.min(axis=0)]
    return steps


def _steps_by_spread() -> Int64[ndarray, " 256"]:
    ratios = 2.0 ** (np.arange(256) / SCALE_STEPS_PER_OCTAVE)
    return np.minimum(np.ceil(_QUAT_PRECISION / 2 * (ratios - 1 / ratios)), MAX_QUAT_STEPS).astype(np.int64)


_STEPS_BY_SPREAD = _steps_by_spread()


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
    """Decode unit quaternions w x y z. Raises CodecError for codes out of range."""
    offsets = others.astype(np.int64) - QUAT_ZERO
    if (largest > 3).any() or (np.abs(offsets) > steps[:, None]).any():
        raise CodecError("subset quats: expected an index of 0 to 3 and components up to the largest, got others")
    full = np.empty((len(steps), 4))
    rows = np.arange(len(steps))
    # a round Gaussian has no steps and no rotation
    full[rows, largest] = np.maximum(steps, 1)
    full[rows[:, None], _OTHERS[largest]] = offsets
    quats_wxyz: Float32[ndarray, "n 4"] = (full / np.linalg.norm(full, axis=1, keepdims=True)).astype(np.float32)
    return quats_wxyz


def encode_opacities(opacities: Float32[ndarray, " n"]) -> UInt8[ndarray, " n"]:
    """Encode opacities in equal bins."""
    return np.clip(np.floor(opacities.astype(np.float64) * OPACITY_BINS), 0, OPACITY_BINS - 1).astype(np.uint8)


def decode_opacities(codes: UInt8[ndarray, " n"]) -> Float32[ndarray, " n"]:
    """Decode opacities as the centres of the bins. Raises CodecError for codes out of range."""
    if (codes >= OPACITY_BINS).any():
        raise CodecError(f"subset opacities: expected codes below {OPACITY_BINS}, got a larger one")
    return ((codes.astype(np.float64) + 0.5) / OPACITY_BINS).astype(np.float32)


def encode_rgb(rgb: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n 3"]:
    """Encode colours as luma and two differences (YCoCg), each clamped; trained colours exceed 0 to 1."""
    red, green, blue = rgb.astype(np.float64).T
    orange = red - blue
    middle = blue + orange / 2
    lime = green - middle
    luma = middle + lime / 2
    codes = np.stack(
        [
            (luma - _LUMA_MIN) * _LUMA_STEPS,
            (orange - _CHROMA_MIN) * _CHROMA_STEPS,
            (lime - _CHROMA_MIN) * _CHROMA_STEPS,
        ],
        axis=1,
    )
    clamped: UInt8[ndarray, "n 3"] = np.clip(np.rint(codes), 0, _MAX_COLOUR_CODE).astype(np.uint8)
    return clamped


def decode_rgb(codes: UInt8[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Decode colours. Raises CodecError for codes out of range."""
    if (codes > _MAX_COLOUR_CODE).any():
        raise CodecError(f"subset rgb: expected codes up to {_MAX_COLOUR_CODE}, got a larger one")
    luma = _LUMA_MIN + codes[:, 0] / _LUMA_STEPS
    orange, lime = (_CHROMA_MIN + codes[:, i] / _CHROMA_STEPS for i in (1, 2))
    middle = luma - lime / 2
    blue = middle - orange / 2
    return np.stack([blue + orange, middle + lime, blue], axis=1).astype(np.float32)
