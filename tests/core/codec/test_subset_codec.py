"""The subset codec: bounded errors, stable bytes, and detection of every damage."""

import struct
from collections.abc import Callable
from dataclasses import fields, replace

import google_crc32c
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from support.sample_batches import make_batch

from gausslite.codec.body import SubsetCoding
from gausslite.codec.columns import OPACITY_BINS, RGB_MAX, RGB_MIN, SCALE_MIN_M
from gausslite.codec.subset_codec import CodecLimits, decode_subset, encode_subset, split_batch
from gausslite.domain.errors import ChecksumError, CodecError, InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid

SIZES_M = [0.1, 0.05, 0.125, 0.1 / 3, 65535 * 2.0**-20, 1.0]


def subset_of(batch: VoxelBatch) -> RoiSubset:
    return RoiSubset("robot-ä", "s1", 7, 11, batch)


# drawn as numbers and built in the test: the shape checks use `random`, which a strategy must not
CASES = st.tuples(
    st.sampled_from(SIZES_M), st.sampled_from([0.0, -3.0, 16.0, 700.0, 20_000.0]), st.integers(0, 2**32 - 1),
    st.integers(0, 60),
)  # fmt: skip


def build(case: tuple[float, float, int, int]) -> tuple[RoiSubset, VoxelGrid]:
    size_m, centre_m, seed, n = case
    grid = VoxelGrid(size_m)
    return subset_of(make_batch(seed, n, grid, 1.0, centre_m)), grid


def covariances(gaussians: Gaussians) -> np.ndarray:
    w, x, y, z = (gaussians.quats_wxyz / np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)).T.astype(float)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    half = rotation * gaussians.scales_m.astype(float)[:, None, :]
    return half @ half.transpose(0, 2, 1)


@given(CASES)
def test_decoding_is_within_the_stated_bounds(case: tuple[float, float, int, int]) -> None:
    subset, grid = build(case)
    # the codec sorts the Gaussians of a voxel, so kappa numbers them
    numbered = replace(subset.batch.gaussians, kappa=np.arange(len(subset.batch.gaussians), dtype=np.uint32))
    subset = replace(subset, batch=replace(subset.batch, gaussians=numbered))
    decoded, decoded_grid = decode_subset(encode_subset(subset, grid))
    got = decoded.batch.gaussians
    sent = subset.batch.gaussians.take(got.kappa.astype(np.int64))
    assert sorted(got.kappa.tolist()) == list(range(len(got)))
    assert decoded_grid == grid
    header = [(s.agent_id, s.session_id, s.message_seq, s.update_seq) for s in (subset, decoded)]
    assert header[0] == header[1]
    for name in ("keys", "kappa_sums", "counts"):
        np.testing.assert_array_equal(getattr(subset.batch, name), getattr(decoded.batch, name))
    for name in ("active", "kappa", "target"):
        np.testing.assert_array_equal(getattr(sent, name), getattr(got, name))
    # half a cell: a quarter of the smallest scale as encoded, or half of the finest cell
    smallest_m = sent.scales_m.min(axis=1, keepdims=True, initial=1e9)
    half_cell_m = np.maximum(0.27 * smallest_m, grid.size_m / 2**16) + np.spacing(np.abs(sent.means_m))
    assert (np.abs(sent.means_m.astype(np.float64) - got.means_m) <= half_cell_m).all()
    np.testing.assert_array_equal(grid.keys(sent.means_m), grid.keys(got.means_m))
    assert (np.abs(np.log(np.maximum(sent.scales_m, SCALE_MIN_M) / got.scales_m)) <= 0.0501).all()
    assert (np.abs(sent.opacities - got.opacities) <= 0.5 / OPACITY_BINS + 1e-7).all()
    inside = (sent.rgb >= RGB_MIN).all(axis=1) & (sent.rgb <= RGB_MAX).all(axis=1)
    assert (np.abs(sent.rgb - got.rgb)[inside] <= 0.0235).all()


@given(st.integers(0, 2**32 - 1), st.floats(1.0, 20.0))
def test_the_shape_of_a_gaussian_is_kept(seed: int, ratio: float) -> None:
    grid = VoxelGrid()
    batch = make_batch(seed, 30, grid)
    scales = np.exp(np.random.default_rng(seed).uniform(0, np.log(ratio), (30, 3))).astype(np.float32) * 5e-5
    numbered = replace(batch.gaussians, scales_m=scales, kappa=np.arange(30, dtype=np.uint32))
    decoded, _ = decode_subset(encode_subset(subset_of(replace(batch, gaussians=numbered)), grid))
    got = decoded.batch.gaussians
    sent = numbered.take(got.kappa.astype(np.int64))
    # in the axes of the Gaussian that was sent, scaled to a unit sphere
    root = np.linalg.inv(np.linalg.cholesky(covariances(sent)))
    change = root @ covariances(got) @ root.transpose(0, 2, 1) - np.eye(3)
    assert (np.abs(np.linalg.eigvalsh(change)) < 0.6).all()
    assert np.median(np.abs(change)) < 0.1


@given(CASES)
def test_a_lossless_message_holds_every_bit(case: tuple[float, float, int, int]) -> None:
    subset, grid = build(case)
    message = encode_subset(subset, grid, SubsetCoding.LOSSLESS)
    decoded, _ = decode_subset(message)
    for name in ("keys", "kappa_sums", "counts"):
        np.testing.assert_array_equal(getattr(subset.batch, name), getattr(decoded.batch, name))
    for field in fields(Gaussians):
        sent, got = (getattr(each.batch.gaussians, field.name) for each in (subset, decoded))
        assert sent.tobytes() == got.tobytes(), field.name


def test_a_small_map_takes_at_most_twelve_bytes_a_gaussian() -> None:
    grid = VoxelGrid()
    rng = np.random.default_rng(0)
    batch = make_batch(1, 4000, grid, spread_m=0.2)
    colours = np.clip(0.5 + rng.normal(0, 0.15, (4000, 1)) + rng.normal(0, 0.05, (4000, 3)), 0, 1)
    scales = np.exp(rng.normal(np.log(4e-3), 0.7, (4000, 3)))
    typical = replace(
        batch.gaussians, rgb=colours.astype(np.float32), scales_m=scales.astype(np.float32),
        kappa=np.full(4000, 40, np.uint32), target=np.zeros(4000, np.int16), active=np.ones(4000, np.bool_),
    )  # fmt: skip
    assert len(encode_subset(subset_of(replace(batch, gaussians=typical)), grid)) <= 12 * 4000


@given(CASES)
def test_encoding_a_decoded_message_gives_the_same_bytes(case: tuple[float, float, int, int]) -> None:
    for coding in SubsetCoding:
        message = encode_subset(*build(case), coding)
        assert encode_subset(*decode_subset(message), coding) == message


@given(CASES, st.data())
def test_any_damage_is_detected(case: tuple[float, float, int, int], data: st.DataObject) -> None:
    message = bytearray(encode_subset(*build(case), data.draw(st.sampled_from(SubsetCoding))))
    place = data.draw(st.integers(0, len(message) - 1))
    message[place] ^= data.draw(st.integers(1, 255))
    pytest.raises((CodecError, ChecksumError), decode_subset, bytes(message))
    pytest.raises((CodecError, ChecksumError), decode_subset, bytes(message[:place]))


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(noise: bytes) -> None:
    pytest.raises((CodecError, ChecksumError), decode_subset, noise)


@given(CASES, st.data())
def test_a_changed_message_with_a_valid_checksum_is_refused_or_gives_a_valid_batch(
    case: tuple[float, float, int, int], data: st.DataObject
) -> None:
    message = bytearray(encode_subset(*build(case), data.draw(st.sampled_from(SubsetCoding)))[:-4])
    place = data.draw(st.integers(0, len(message) - 1))
    message[place] ^= data.draw(st.integers(1, 255))
    forged = bytes(message) + struct.pack("<I", google_crc32c.value(bytes(message)))
    try:
        subset, grid = decode_subset(forged)
    except (CodecError, ChecksumError):
        return
    # the flip changed a value: the batch is valid, and encoding it again is stable
    gaussians = subset.batch.gaussians
    for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb"):
        assert np.isfinite(getattr(gaussians, name)).all(), name
    assert (gaussians.scales_m > 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    np.testing.assert_array_equal(
        grid.keys(gaussians.means_m), np.repeat(subset.batch.keys, subset.batch.counts.astype(np.int64))
    )
    again = encode_subset(subset, grid)
    decoded, decoded_grid = decode_subset(again)
    assert decoded_grid == grid
    for name in ("keys", "kappa_sums", "counts"):
        np.testing.assert_array_equal(getattr(decoded.batch, name), getattr(subset.batch, name))
    assert encode_subset(decoded, decoded_grid) == again


def forge(body: bytes, voxels: int, gaussians: int, size_m: float = 0.1, version: int = 2, coding: int = 1) -> bytes:
    counts = (voxels, gaussians, len(body))
    header = struct.pack("<4sHBBBBBIIIdQQBB", b"GLSB", version, coding, 1, 1, 3, 100, *counts, size_m, 1, 1, 1, 0)
    message = header + b"a" + body
    return message + struct.pack("<I", google_crc32c.value(message))


def packed(data: bytes, declares_size: bool = True) -> bytes:
    return zstandard.ZstdCompressor(level=3, write_content_size=declares_size).compress(data)


def sized(frame: bytes) -> bytes:
    return struct.pack("<I", len(frame)) + frame


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: forge(b"", 0, 0, version=1), r"expected b'GLSB' version 2, got b'GLSB' version 1"),
        (lambda: forge(b"", 0, 0, coding=2), "expected coding 0 or 1, got 2"),
        # a decompression bomb, with its size and without
        (lambda: forge(packed(bytes(1 << 28)), 1, 0), "expected a body of 20 bytes"),
        (lambda: forge(packed(bytes(1 << 28), False), 1, 0), "expected a body of 20 bytes"),
        (lambda: forge(sized(packed(bytes(1 << 28))), 1, 0, coding=0), "expected a body of 20 bytes"),
        (lambda: forge(sized(packed(bytes(1 << 28), False)), 1, 0, coding=0), "expected a body of 20 bytes"),
        (lambda: forge(struct.pack("<I", 2**32 - 1), 1, 0, coding=0), "a longer one"),
        (lambda: forge(b"", 2**32 - 1, 0), "at most 200000 voxels"),
        (lambda: bytes(CodecLimits().max_bytes + 1), "at most 1048576 bytes"),
        (lambda: forge(packed(struct.pack("<qQI", 5, 0, 1)), 1, 0), "voxel counts sum to 1"),
        (lambda: forge(packed(struct.pack("<qQI", -5, 0, 0)), 1, 0), "negative"),
        (lambda: forge(packed(bytes(20)), 1, 0, size_m=float("nan")), "size_m"),
    ],
)
def test_a_forged_message_is_refused_before_anything_is_allocated(call: Callable[[], bytes], message: str) -> None:
    pytest.raises(CodecError, decode_subset, call()).match(message)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("means_m", np.nan),
        ("rgb", np.inf),
        ("scales_m", 0.0),
        ("opacities", 1.5),
        ("quats_wxyz", 0.0),
        ("means_m", 9.0),
    ],
)
def test_invalid_values_are_not_encoded(column: str, value: float) -> None:
    batch = make_batch(0, 10, VoxelGrid())
    getattr(batch.gaussians, column)[3] = value
    pytest.raises(InvalidInputError, encode_subset, subset_of(batch), VoxelGrid()).match(column)


@given(st.integers(0, 1000), st.integers(0, 400), st.integers(1100, 6000))
def test_split_parts_fit_and_contain_the_whole_batch(seed: int, n: int, max_bytes: int) -> None:
    grid = VoxelGrid()
    batch = make_batch(seed, n, grid, spread_m=0.5)
    parts = split_batch(batch, max_bytes)
    assert all(len(encode_subset(subset_of(part), grid)) <= max_bytes for part in parts)
    for name in ("keys", "kappa_sums"):
        joined = np.concatenate([np.zeros(0, np.int64), *(getattr(part, name) for part in parts)])
        np.testing.assert_array_equal(joined, getattr(batch, name))
    if not len(batch):
        assert parts == []


def test_a_voxel_too_full_for_a_message_keeps_its_most_opaque_gaussians() -> None:
    grid = VoxelGrid(10.0)
    batch = make_batch(3, 300, grid, spread_m=0.5, centre_m=5.0)
    [part] = [part for part in split_batch(batch, 2048) if len(part.gaussians)]
    kept, sent = part.gaussians, batch.gaussians
    assert 0 < len(kept) < 300
    assert part.kappa_sums.tolist() == batch.kappa_sums[batch.counts > 0].tolist()
    assert kept.opacities.min() >= np.sort(sent.opacities)[-len(kept)]
    pytest.raises(InvalidInputError, split_batch, batch, 100).match("max_bytes")
