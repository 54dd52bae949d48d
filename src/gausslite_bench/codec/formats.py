"""Encode Gaussians with the subset codec and with other formats, and decode them again."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from gausslite.codec.ply import SH_C0, ply_bytes
from gausslite.codec.subset_codec import SubsetCoding, decode_subset, encode_subset, split_batch
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.export.splat_formats import write_splat, write_spz

_GEOMETRY = ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb")


@dataclass(frozen=True, slots=True)
class CodecFormat:
    """A format. encode returns messages or one file; decode, None if not measured, returns the Gaussians of them."""

    name: str
    encode: Callable[[Gaussians], list[bytes]]
    decode: Callable[[list[bytes]], Gaussians] | None = None


def codec_formats() -> list[CodecFormat]:
    """Return the formats of the table; those of gsply only if it is installed."""
    formats = [
        CodecFormat("subset codec", lambda g: _messages(g, SubsetCoding.QUANTISED), _decode_messages),
        CodecFormat("subset codec, lossless", lambda g: _messages(g, SubsetCoding.LOSSLESS), _decode_messages),
        CodecFormat("f32 columns, zstd", lambda g: _columns(g, "<f4"), lambda parts: _from_columns(parts, "<f4")),
        CodecFormat("f16 columns, zstd", lambda g: _columns(g, "<f2"), lambda parts: _from_columns(parts, "<f2")),
        CodecFormat("PLY", lambda g: [ply_bytes(g)]),
        CodecFormat(".splat", lambda g: [_file(g, write_splat, ".splat")]),
    ]
    if importlib.util.find_spec("gsply") is None:
        return formats
    return [
        *formats,
        CodecFormat("SPZ", lambda g: [_file(g, write_spz, ".spz")]),
        CodecFormat("compressed PLY", _compressed_ply),
    ]


def _messages(gaussians: Gaussians, coding: SubsetCoding) -> list[bytes]:
    grid = VoxelGrid()
    parts = split_batch(group_by_voxel(gaussians, grid), coding=coding)
    return [encode_subset(RoiSubset("agent", "", i, i, part), grid, coding) for i, part in enumerate(parts, 1)]


def _decode_messages(messages: list[bytes]) -> Gaussians:
    return Gaussians.concatenate([decode_subset(message)[0].batch.gaussians for message in messages])


def _columns(gaussians: Gaussians, dtype: str) -> list[bytes]:
    """Return one zstd frame per column, byte-shuffled; geometry in this type, labels as they are."""
    compressor = zstandard.ZstdCompressor(level=3)
    frames = []
    for field in fields(Gaussians):
        values = getattr(gaussians, field.name)
        column = np.ascontiguousarray(values.astype(dtype) if field.name in _GEOMETRY else values).reshape(-1)
        frames.append(compressor.compress(column.view(np.uint8).reshape(-1, column.itemsize).T.tobytes()))
    return frames


def _from_columns(frames: list[bytes], dtype: str) -> Gaussians:
    empty, columns = Gaussians.empty(), []
    for field, frame in zip(fields(Gaussians), frames, strict=True):
        like = getattr(empty, field.name)
        kind = np.dtype(dtype if field.name in _GEOMETRY else like.dtype)
        planes = np.frombuffer(zstandard.ZstdDecompressor().decompress(frame), np.uint8).reshape(kind.itemsize, -1)
        values = np.ascontiguousarray(planes.T).reshape(-1).view(kind).astype(like.dtype)
        columns.append(values.reshape(-1, *like.shape[1:]))
    return Gaussians(*columns)


def _file(gaussians: Gaussians, write: Callable[[Path, Gaussians], None], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{suffix}"
        write(path, gaussians)
        return path.read_bytes()


def _compressed_ply(gaussians: Gaussians) -> list[bytes]:
    import gsply

    opacity = np.clip(gaussians.opacities, 1e-6, 1 - 1e-6)
    data: Any = gsply.GSData(
        means=gaussians.means_m,
        scales=np.log(gaussians.scales_m),
        quats=gaussians.quats_wxyz,
        opacities=np.log(opacity / (1 - opacity)),
        sh0=((gaussians.rgb - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(gaussians), 0, 3), np.float32),
    )
    return [bytes(gsply.compress_to_bytes(data))]
