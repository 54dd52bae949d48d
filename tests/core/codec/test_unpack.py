"""The native code unpacks bodies as NumPy does, and refuses what NumPy refuses."""

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.reference_unpack import reference_unpack
from support.sample_batches import make_batch

from gausslite.codec._unpack import unpack
from gausslite.codec.body import BodyLayout, encode_quantised, quantised_columns
from gausslite.codec.columns import QUAT_STEPS, PositionPrecision, decompress
from gausslite.domain.errors import CodecError
from gausslite.domain.voxels import VoxelGrid

CASES = st.tuples(st.sampled_from([0.1, 0.05, 1.0]), st.integers(0, 2**32 - 1), st.integers(0, 80))
Body = tuple[BodyLayout, bytes, bytes]
Unpacked = tuple[bytes, bytes, bytes] | None


def body_of(case: tuple[float, int, int]) -> Body:
    """The layout, the decompressed frame and the bit fields of a random message."""
    size_m, seed, n = case
    grid = VoxelGrid(size_m)
    batch = make_batch(seed, n, grid, spread_m=3 * size_m)
    layout = BodyLayout.of(batch, PositionPrecision.of(n, len(batch), grid))
    body = encode_quantised(batch, grid, layout)
    end = 4 + struct.unpack_from("<I", body)[0]
    size = sum(column.byte_count for column in quantised_columns(layout))
    return layout, decompress(body[4:end], size), body[end:]


def both(body: Body, update_seq: int, adds_stated: bool) -> tuple[Unpacked, Unpacked]:
    """What the native code and the oracle return, None where they refuse the body."""
    layout, frame, fields = body
    results: list[Unpacked] = []
    for run, argument, error in ((unpack, layout.widths, ValueError), (reference_unpack, layout, CodecError)):
        extra: tuple[Any, ...] = (QUAT_STEPS,) if run is unpack else ()
        try:
            results.append(run(frame, fields, argument, *extra, update_seq, adds_stated))
        except error:
            results.append(None)
    return results[0], results[1]


@given(CASES, st.integers(0, 2**64 - 1), st.booleans())
def test_every_bit_is_that_of_the_oracle(case: tuple[float, int, int], update_seq: int, adds_stated: bool) -> None:
    native, oracle = both(body_of(case), update_seq, adds_stated)
    assert native is not None
    assert native == oracle


@settings(max_examples=3 * settings.default.max_examples)
@given(CASES, st.data())
def test_a_damaged_body_is_refused_as_by_the_oracle(case: tuple[float, int, int], data: st.DataObject) -> None:
    layout, frame, fields = body_of(case)
    for _ in range(data.draw(st.integers(1, 3))):
        part = data.draw(st.sampled_from(["frame", "fields", "length", "precision"]))
        if part == "length":
            fields = data.draw(st.sampled_from([fields[:-1], fields + b"\0", b"", fields * 2]))
        elif part == "precision":
            precision = PositionPrecision(data.draw(st.integers(0, 5)), data.draw(st.integers(0, 255)))
            layout = replace(layout, precision=precision)
        else:
            changed = bytearray(frame if part == "frame" else fields)
            if changed:
                changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
            frame, fields = (bytes(changed), fields) if part == "frame" else (frame, bytes(changed))
    native, oracle = both((layout, frame, fields), 1, True)
    assert native == oracle


def test_sizes_are_checked_before_anything_is_allocated() -> None:
    for widths in ((2**32 - 1, 0, 1, 1, 3, 100), (0, 2**32 - 1, 1, 1, 3, 100), (2**63, 2**63, 1, 1, 3, 100)):
        pytest.raises(ValueError, unpack, bytes(20), b"", widths, QUAT_STEPS, 1, True).match("expected")
    for widths in ((1, 0, 3, 9, 3, 100), (1, 0, 1, 1, 6, 100), (1, 0, 1, 1, -1, 100)):
        pytest.raises(ValueError, unpack, bytes(20), b"", widths, QUAT_STEPS, 1, True).match(r"width|coarse")


def test_a_large_body_is_unpacked_too() -> None:
    """It runs without the interpreter's lock."""
    body = body_of((1.0, 3, 20_000))
    native, oracle = both(body, 5, True)
    assert native is not None
    assert np.array_equal(native, oracle)
