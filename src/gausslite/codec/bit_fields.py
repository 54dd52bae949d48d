"""Pack unsigned numbers of different widths without gaps, low bit first."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import CodecError

_WINDOW_BYTES = 3


def pack_bits(values: Int64[ndarray, " n"], widths: Int64[ndarray, " n"]) -> bytes:
    """Return the low widths[i] bits of values[i], one value after the other; the last byte is filled with zeros."""
    bit_indices = np.arange(int(widths.max(initial=0)))
    bits = (values[:, None] >> bit_indices & 1).astype(np.uint8)
    return np.packbits(bits[bit_indices < widths[:, None]], bitorder="little").tobytes()


def unpack_bits(data: bytes, widths: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the values of these widths, each at most 17 bits.

    Raises CodecError if the data has another size or a bit after the last.
    """
    ends = np.cumsum(widths)
    total = int(ends[-1]) if len(ends) else 0
    if len(data) != (total + 7) // 8:
        raise CodecError(f"subset: expected {(total + 7) // 8} bytes of bit fields, got {len(data)}")
    if total % 8 and data[-1] >> total % 8:
        raise CodecError("subset: expected zeros after the last bit field, got other bits")
    starts = ends - widths
    first, padded = starts >> 3, np.frombuffer(data + bytes(_WINDOW_BYTES), np.uint8).astype(np.int64)
    # a field of 17 bits that begins at the last bit of a byte ends in the second byte after it
    window = padded[first] | padded[first + 1] << 8 | padded[first + 2] << 16
    values: Int64[ndarray, " n"] = window >> (starts & 7) & (np.int64(1) << widths) - 1
    return values
