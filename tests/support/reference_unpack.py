"""The body of a quantised message unpacked column by column with NumPy: the oracle of the native code."""

from typing import Any

import numpy as np

from gausslite.codec.body import BodyLayout, decode_differences, decode_kappa_sums, decode_labels, decode_voxels
from gausslite.codec.columns import (
    MAX_COARSE_BITS,
    MAX_FINE_BITS,
    OPACITY_BINS,
    QUAT_ZERO,
    Column,
    _unshuffle,
    quat_steps,
)
from gausslite.codec.encoded_voxels import CODES, OPACITY_BITS, TARGET_BITS, voxel_table
from gausslite.domain.errors import CodecError


def reference_unpack(
    frame: bytes, fields: bytes, layout: BodyLayout, update_seq: int, adds_stated: bool
) -> tuple[bytes, bytes, bytes]:
    """Return what `gausslite.codec._unpack.unpack` returns. Raises CodecError."""
    columns = [
        *layout.voxel_columns(), *[Column("<u1", (layout.gaussians,))] * 12, *layout.label_columns(),
    ]  # fmt: skip
    ends = np.cumsum([column.byte_count for column in columns]).tolist()
    raw = [_unshuffle(frame[start:end], column) for column, start, end in zip(columns, [0, *ends], ends, strict=False)]
    of_voxels, (lengths, first, second, third, largest, *rest), labels = raw[:3], raw[3:-3], raw[-3:]
    keys, offsets = decode_voxels(of_voxels, layout)
    codes = decode_differences(first)
    scales, quats = np.stack([codes, codes + second, codes + third], axis=1), np.stack(rest[:3], axis=1)
    bits, rgb = layout.precision.bits(scales), decode_differences(np.stack(rest[4:], axis=1))
    if (largest > 3).any() or (np.abs(quats.astype(int) - QUAT_ZERO) > quat_steps(scales)[:, None]).any():
        raise CodecError("quats")
    if (rest[3] >= OPACITY_BINS).any() or (rgb > 128).any():
        raise CodecError("opacities or rgb")
    cells = _cells(lengths, fields, bits, offsets[:-1][raw[2] > 0], layout.precision.coarse_bits)
    active, kappa, target = decode_labels(labels)
    gaussians = np.empty(layout.gaussians, CODES)
    gaussians["fractions"] = (2 * cells + 1) << (MAX_FINE_BITS - bits)[:, None]
    gaussians["scales"], gaussians["quats"], gaussians["rgb"], gaussians["kappa"] = scales, quats, rgb, kappa
    gaussians["largest_and_opacity"] = largest << OPACITY_BITS | rest[3]
    label = np.clip(target, -1, (1 << TARGET_BITS) - 2) + 1
    gaussians["active_and_target"] = active.astype(np.uint8) << TARGET_BITS | label.astype(np.uint8)
    stated = of_voxels if adds_stated else [of_voxels[0], np.zeros_like(of_voxels[1])]
    table = voxel_table(keys, update_seq, decode_kappa_sums(stated, kappa, offsets), raw[2])
    targets = target.astype("<i2").tobytes() if (label != target + 1).any() else b""
    return table.tobytes(), gaussians.tobytes(), targets


def _cells(
    lengths: np.ndarray[Any, Any], packed: bytes, bits: np.ndarray[Any, Any], starts: np.ndarray[Any, Any], coarse: int
) -> np.ndarray[Any, Any]:
    n, wide, fine = len(lengths), lengths.astype(np.int64), bits - coarse
    if (wide > 3 * coarse).any():
        raise CodecError("a long difference")
    values = _bit_fields(packed, np.concatenate([np.maximum(wide - 1, 0), fine, fine, fine]))
    deltas = values[:n] | (np.int64(1) << wide) >> 1
    totals = np.concatenate([np.zeros(1, np.int64), np.cumsum(deltas)])
    codes = totals[1:] - np.repeat(totals[starts], np.diff(starts, append=n))
    if (codes >> 3 * coarse).any():
        raise CodecError("a cell outside its voxel")
    cells = np.zeros((n, 3), np.int64)
    for place in range(MAX_COARSE_BITS):
        for axis in range(3):
            cells[:, axis] |= (codes >> (3 * place + 2 - axis) & 1) << place
    low: np.ndarray[Any, Any] = values[n:].reshape(3, n).T
    return low | cells << fine[:, None]


def _bit_fields(data: bytes, widths: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    total = int(widths.sum())
    if len(data) != (total + 7) // 8 or bits[total:].any():
        raise CodecError("bit fields")
    places = np.arange(MAX_FINE_BITS + 1)
    wanted = places < widths[:, None]
    values = np.zeros(wanted.shape, np.int64)
    values[wanted] = bits[:total]
    return (values << places).sum(axis=1)
