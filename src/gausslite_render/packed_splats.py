"""Decode splat files that other tools packed: .splat, SPZ, ksplat and SuperSplat's compressed PLY.

Files of strangers are decoded here by NumPy, which checks bounds, and not by a library in C++. All sizes that a file
states are compared with its bytes before memory is taken. Decoders raise MapFileError, or what NumPy raises for too
few bytes.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import zstandard
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.ply import SH_C0
from gausslite.domain.errors import MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite_render.harmonics import COUNTS

MAX_GAUSSIANS: Final = 20_000_000
"""Of a file that is unpacked: 5 GB with harmonics of degree 3."""
_SPLAT_ROW = np.dtype([("mean_m", "<f4", 3), ("scale_m", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])
_SPZ_MAGIC, _SPZ_HEADER, _SPZ_COLOUR_SCALE = 0x5053474E, struct.Struct("<IIIBBBB"), 0.15
_SPZ_EXTENSION_BYTES = 1 << 16
_CHUNK_ROWS, _SH_REACH = 256, 8.0
_COMPRESSED_PLY = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n(?:(?:comment|obj_info)[^\n]*\n)*"
    rb"element chunk (\d{1,8})\n((?:property float \w+\n){12}(?:(?:property float \w+\n){6})?)"
    rb"element vertex (\d{1,8})\n(?:property uint packed_\w+\n){4}"
    rb"(?:element sh (\d{1,8})\n((?:property uchar f_rest_\d+\n)+))?end_header\n"
)
_KSPLAT_HEADER, _KSPLAT_MODES = 4096, (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Bytes; types of a mean, of scales and rotations, and of harmonics, by the mode of compression."""
_KSPLAT_SECTION = np.dtype(
    {
        "names": ["count", "room", "capacity", "buckets", "block_m", "bucket_bytes", "range", "full", "partial", "sh"],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """The columns of a file, as PLY files have them; harmonics: coefficients above degree 0 for each channel."""

    means_m: NDArray[Any]
    quats_wxyz: NDArray[Any]
    scales_m: NDArray[Any]
    opacities: NDArray[Any]
    rgb: NDArray[Any]
    harmonics: NDArray[Any]

    def gaussians(self) -> Gaussians:
        """Return them as Gaussians that belong to no task."""
        columns = (self.means_m, self.quats_wxyz, self.scales_m, self.opacities, self.rgb)
        means_m, quats, scales_m, opacities, rgb = (np.ascontiguousarray(values, np.float32) for values in columns)
        n, positive_m = len(means_m), np.maximum(scales_m, np.finfo(np.float32).tiny)
        active, kappa, target = np.zeros(n, np.bool_), np.zeros(n, np.uint32), np.full(n, NO_TARGET, np.int16)
        return Gaussians(means_m, quats, positive_m, opacities, rgb, active=active, kappa=kappa, target=target)


def require(condition: bool, expected: str, got: object) -> None:
    """Raise MapFileError unless the condition holds."""
    if not condition:
        raise MapFileError(f"expected {expected}, got {got}")


def require_count(count: int) -> None:
    """Raise MapFileError for more Gaussians than are unpacked."""
    require(0 < count <= MAX_GAUSSIANS, f"1 to {MAX_GAUSSIANS} Gaussians", count)


def rgb_of(coefficients: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    """Return the colours that coefficients of degree 0 stand for."""
    return coefficients * np.float32(SH_C0) + np.float32(0.5)


def with_largest(largest: NDArray[Any], others: NDArray[Any]) -> Float32[ndarray, "n 4"]:
    """Return unit quaternions of their three smaller components, in their order, and the largest one's place."""
    is_other, quats = np.arange(4) != largest[:, None], np.empty((len(others), 4), np.float32)
    quats[is_other] = others.ravel()
    quats[~is_other] = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    return quats


def decode_splat(data: bytes) -> Splats:
    """Decode rows of 32 bytes, with colours and rotations in 8 bits."""
    row = _SPLAT_ROW.itemsize
    require(len(data) % row == 0, f"rows of {row} bytes", f"{len(data)} bytes")
    require_count(len(data) // row)
    rows = np.frombuffer(data, _SPLAT_ROW)
    rgba, quats = rows["rgba"].astype(np.float32) / 255, rows["quat_wxyz"].astype(np.float32) / 128 - 1
    none = np.zeros((len(rows), 3, 0), np.float32)
    return Splats(rows["mean_m"], quats, rows["scale_m"], rgba[:, 3], rgba[:, :3], none)


def decode_spz(data: bytes) -> Splats:
    """Decode SPZ of version 2 or 3, which is packed as a whole, or 4, which has a packed stream for each column."""
    packed = data[:2] == b"\x1f\x8b"
    with gzip.open(io.BytesIO(data)) if packed else io.BytesIO(data) as file:
        magic, version, count, degree, fraction_bits, _, streams = _SPZ_HEADER.unpack(file.read(_SPZ_HEADER.size))
        require(magic == _SPZ_MAGIC, "an SPZ file", "another file")
        require(version in (2, 3, 4) and packed == (version < 4), "version 2, 3 or 4", version)
        require_count(count)
        require(degree < len(COUNTS), "harmonics of degree 0 to 3", degree)
        sizes = [count * size for size in (9, 1, 3, 3, 3 if version == 2 else 4, 3 * COUNTS[degree])]
        if packed:
            columns = [file.read(size) for size in sizes]
            file.read(_SPZ_EXTENSION_BYTES)  # to the end, where gzip compares its checksum
            short = sum(sizes) - sum(map(len, columns))
            require(not short, f"{sum(sizes)} bytes of {count} Gaussians", f"{short} fewer")
        else:
            columns = _spz_streams(data, streams, [size for size in sizes if size])
    bytes_, alphas, colours, scales, turns = (np.frombuffer(column, np.uint8) for column in columns[:5])
    places = bytes_.reshape(count, 3, 3).astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
    places -= (places >> 23) << 24  # 24 bits with a sign
    rest = np.frombuffer(columns[5] if degree else b"", np.uint8).reshape(count, COUNTS[degree], 3)
    return Splats(
        means_m=places.astype(np.float32) / np.float32(2.0**fraction_bits),
        quats_wxyz=_spz_quats(turns.reshape(count, -1))[:, [3, 0, 1, 2]],
        scales_m=np.exp(scales.reshape(count, 3) / np.float32(16) - 10),
        opacities=alphas / np.float32(255),
        rgb=rgb_of((colours.reshape(count, 3) / np.float32(255) - np.float32(0.5)) / np.float32(_SPZ_COLOUR_SCALE)),
        harmonics=(rest.transpose(0, 2, 1) - np.float32(128)) / np.float32(128),
    )


def _spz_streams(data: bytes, streams: int, sizes: Sequence[int]) -> list[bytes]:
    """Unpack the columns of version 4; their table states the packed and the unpacked size of each."""
    (start,) = struct.unpack_from("<I", data, _SPZ_HEADER.size)
    require(streams == len(sizes), f"{len(sizes)} streams", streams)
    table, end, columns = np.frombuffer(data, "<u8", 2 * streams, start), start + 16 * streams, []
    for size, packed in zip(sizes, table[::2].tolist(), strict=True):
        frame, end = data[end : end + packed], end + packed
        stated = zstandard.get_frame_parameters(frame).content_size
        require(stated == size, f"a stream of {size} bytes", stated)
        columns.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=size))
    return columns


def _spz_quats(turns: NDArray[Any]) -> Float32[ndarray, "n 4"]:
    """Return rotations as x, y, z, w: three bytes hold x, y, z; four hold the smaller three in 10 bits each."""
    if turns.shape[1] == 3:
        return with_largest(np.full(len(turns), 3), turns / np.float32(127.5) - 1)
    words = np.ascontiguousarray(turns).view("<u4")
    parts = words >> np.array([20, 10, 0], np.uint32)
    sizes = (parts & 511) * np.float32(np.sqrt(0.5) / 511)
    return with_largest(words[:, 0] >> 30, np.where(parts & 512, -sizes, sizes))


def decode_compressed_ply(data: bytes) -> Splats:
    """Decode SuperSplat's PLY: bits between the limits of a chunk of 256 Gaussians."""
    header = _COMPRESSED_PLY.match(data)
    if header is None:
        raise MapFileError("expected the header of SuperSplat's compressed PLY, got another one")
    chunks, count, coefficients = int(header[1]), int(header[3]), len((header[5] or b"").splitlines())
    require_count(count)
    require(chunks == -(-count // _CHUNK_ROWS), f"a chunk for {_CHUNK_ROWS} of {count} Gaussians", f"{chunks} chunks")
    fits = coefficients % 3 == 0 and coefficients // 3 in COUNTS and int(header[4] or count) == count
    require(fits, f"harmonics of degree 1 to 3 for {count} Gaussians", f"{int(header[4] or 0)} rows of {coefficients}")
    width, start = len(header[2].splitlines()), header.end()
    limits = np.frombuffer(data, "<f4", chunks * width, start).reshape(chunks, width // 6, 2, 3)
    words = np.frombuffer(data, "<u4", count * 4, start + chunks * width * 4).reshape(count, 4)
    rest = np.frombuffer(data, np.uint8, count * coefficients, start + chunks * width * 4 + count * 16)
    chunk = np.arange(count) // _CHUNK_ROWS

    def between(kind: int, shares: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        if kind >= limits.shape[1]:
            return shares  # early files have no limits of colours
        low, high = limits[chunk, kind].transpose(1, 0, 2)
        return np.asarray(low * (1 - shares) + high * shares)

    rgba = _bits(words[:, 3], (8, 8, 8, 8))
    shares = np.where(rest == 0, 0, np.where(rest == 255, 1, (rest + 0.5) / 256))
    return Splats(
        means_m=between(0, _bits(words[:, 0], (11, 10, 11))),
        quats_wxyz=with_largest(words[:, 1] >> 30, (_bits(words[:, 1], (10, 10, 10)) - 0.5) * np.sqrt(2)),
        scales_m=np.exp(between(1, _bits(words[:, 2], (11, 10, 11)))),
        opacities=rgba[:, 3],
        rgb=between(2, rgba[:, :3]),
        harmonics=((shares - 0.5) * _SH_REACH).reshape(count, 3, coefficients // 3),
    )


def _bits(words: NDArray[Any], widths: Sequence[int]) -> Float64[ndarray, "n k"]:
    """Return numbers of these widths, the last one in the lowest bits, as shares of their largest value."""
    parts, shift = [], 0
    for width in reversed(widths):
        parts.append((words >> shift & (1 << width) - 1) / ((1 << width) - 1))
        shift += width
    return np.stack(parts[::-1], axis=1)


def decode_ksplat(data: bytes) -> Splats:
    """Decode .ksplat of GaussianSplats3D: sections whose positions are relative to the centres of buckets."""
    sections, count, mode = (struct.unpack_from(kind, data, at)[0] for kind, at in (("<I", 4), ("<I", 16), ("<H", 20)))
    require(data[0] == 0 and data[1] > 0 and mode < 3, "ksplat 0.1 in mode 0 to 2", f"{data[0]}.{data[1]} in {mode}")
    require_count(count)
    headers = np.frombuffer(data, _KSPLAT_SECTION, sections, _KSPLAT_HEADER)
    total, degree = int(headers["count"].sum(dtype=np.int64)), int(headers["sh"].max(initial=0))
    require(total == count, f"sections of {count} Gaussians", f"sections of {total}")
    require(degree < len(COUNTS), "harmonics of degree 0 to 3", degree)
    start, parts = _KSPLAT_HEADER + headers.nbytes, []
    low, high = (value or limit for value, limit in zip(struct.unpack_from("<2f", data, 36), (-1.5, 1.5), strict=True))
    for header in headers:
        stated = {name: header[name].item() for name in _KSPLAT_SECTION.names or ()}
        rows, means_m, start = _ksplat_section(data, start, stated, mode)
        harmonics = np.zeros((len(rows), 3, COUNTS[degree]), np.float32)
        known = rows["sh"] / np.float32(255) * np.float32(high - low) + np.float32(low) if mode == 2 else rows["sh"]
        for first, last in pairwise(COUNTS[: stated["sh"] + 1]):  # a degree, then its channels
            harmonics[:, :, first:last] = known[:, 3 * first : 3 * last].reshape(-1, 3, last - first)
        rgba = rows["rgba"] / np.float32(255)
        parts.append((means_m, rows["quat"], rows["scale_m"], rgba[:, 3], rgba[:, :3], harmonics))
    return Splats(*(np.concatenate(column).astype(np.float32) for column in zip(*parts, strict=True)))


def _ksplat_section(
    data: bytes, start: int, stated: dict[str, Any], mode: int
) -> tuple[NDArray[Any], NDArray[Any], int]:
    """Return the rows of a section, their means, and where the next section starts."""
    mean, value, harmonic = _KSPLAT_MODES[mode]
    row = np.dtype(
        [
            *(("mean", mean, 3), ("scale_m", value, 3), ("quat", value, 4), ("rgba", "u1", 4)),
            ("sh", harmonic, 3 * COUNTS[stated["sh"]]),
        ]
    )
    require(stated["count"] <= stated["room"], f"at most {stated['room']} Gaussians in a section", stated["count"])
    partial, count = np.frombuffer(data, "<u4", stated["partial"], start), stated["count"]
    centres_m = np.frombuffer(data, "<f4", 3 * stated["buckets"], start + partial.nbytes).reshape(-1, 3)
    start += partial.nbytes + stated["buckets"] * stated["bucket_bytes"]
    rows = np.frombuffer(data, row, count, start)
    means_m: Float32[ndarray, "n 3"] = rows["mean"]
    if mode:
        full: Int64[ndarray, " n"] = np.arange(count) // max(stated["capacity"], 1)
        in_full = stated["full"] * stated["capacity"]
        later = stated["full"] + np.searchsorted(np.cumsum(partial), np.arange(count) - in_full, side="right")
        bucket = np.where(np.arange(count) < in_full, full, later)
        middle = np.float32(stated["range"] or 32767)
        means_m = (rows["mean"] - middle) * np.float32(stated["block_m"] / 2 / middle) + centres_m[bucket]
    return rows, means_m, start + stated["room"] * row.itemsize
