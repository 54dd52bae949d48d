"""Pack unsigned numbers of different widths without gaps, low bit first."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import CodecError


def pack_bits(values: Int64[ndarray, " n"], widths: Int64[ndarray, " n"]) -> bytes:
    """Return the low widths[i] bits of values[i], one value after the other; the last byte is filled with zeros."""
    places = np.arange(int(widths.max(initial=0)))
    bits = (values[:, None] >> places & 1).astype(np.uint8)
    return np.packbits(bits[places < widths[:, None]], bitorder="little").tobytes()


def unpack_bits(data: bytes, widths: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the values of these widths. Raises CodecError if the data has another size or a bit after the last."""
    total = int(widths.sum())
    if len(data) != (total + 7) // 8:
        raise CodecError(f"subset: expected {(total + 7) // 8} bytes of bit fields, got {len(data)}")
    flat: UInt8[ndarray, " b"] = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    if flat[total:].any():
        raise CodecError("subset: expected zeros after the last bit field, got other bits")
    places = np.arange(int(widths.max(initial=0)))
    bits = np.zeros((len(widths), len(places)), np.uint8)
    bits[places < widths[:, None]] = flat[:total]
    values: Int64[ndarray, " n"] = bits.astype(np.int64) @ (np.int64(1) << places)
    return values
