"""Read a splat map of any trainer with its colours that depend on the view: PLY, .splat, SPZ, SOG or .ksplat."""

from __future__ import annotations

import gzip
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import zstandard

from gausslite.codec.ply import StoredMap, read_stored_map
from gausslite.domain.errors import MapFileError
from gausslite.domain.file_formats import foreign_file
from gausslite.mission.results import map_file
from gausslite_render.packed_splats import (
    MAX_GAUSSIANS,
    Splats,
    decode_compressed_ply,
    decode_ksplat,
    decode_splat,
    decode_spz,
    require,
)
from gausslite_render.sog import decode_sog

_DECODERS = {".splat": decode_splat, ".spz": decode_spz, ".sog": decode_sog, ".ksplat": decode_ksplat}
_OWN_FORMATS = {".spz": "an SPZ map", ".sog": "a zip archive; unpack it first", ".ply": "a PLY map"}
_MAX_BYTES = MAX_GAUSSIANS * 62 * 4
_HEADER_BYTES, _FINITE = 1 << 12, "finite values"
_DAMAGED = (
    *(ValueError, LookupError, TypeError, AttributeError, EOFError, OverflowError, RuntimeError, MemoryError),
    *(gzip.BadGzipFile, struct.error, zlib.error, zipfile.BadZipFile, zstandard.ZstdError, cv2.error),
)
"""What libraries raise for too few bytes or other types than a decoder expects."""


def read_splats(path: Path) -> StoredMap:
    """Read a splat file by its suffix, or the map of a results folder. Rows that are no Gaussians are left out.

    Raises MapFileError naming the file and the cause.
    """
    file = map_file(path)
    try:
        decode = _decoder(file)
        found = read_stored_map(file) if decode is None else _decoded(file, decode)
    except OSError as error:
        raise MapFileError(f"{file}: cannot read the map: {error.strerror or error}") from error
    if not len(found.gaussians):
        raise MapFileError(f"{file}: expected a map with at least one Gaussian, got an empty map")
    return found


def _decoder(file: Path) -> Callable[[bytes], Splats] | None:
    """Return what decodes the file; None for a PLY file that is not packed."""
    if (found := _DECODERS.get(file.suffix.lower())) is not None:
        return found
    with file.open("rb") as start:
        return decode_compressed_ply if b"\nelement chunk " in start.read(_HEADER_BYTES) else None


def _decoded(file: Path, decode: Callable[[bytes], Splats]) -> StoredMap:
    """Return the rows without NaN or infinity. Raises MapFileError, also if none is left."""
    try:
        require(file.stat().st_size <= _MAX_BYTES, f"at most {_MAX_BYTES} bytes", file.stat().st_size)
        with np.errstate(over="ignore", invalid="ignore"):
            splats = decode(file.read_bytes())
            gaussians, harmonics = splats.gaussians(), np.ascontiguousarray(splats.harmonics, np.float32)
        columns = (getattr(gaussians, name) for name in ("means_m", "scales_m", "quats_wxyz", "opacities", "rgb"))
        finite = (np.isfinite(column).reshape(len(gaussians), -1).all(axis=1) for column in (*columns, harmonics))
        kept = np.logical_and.reduce(list(finite))
        require(bool(kept.any()), _FINITE, "NaN or infinity")
    except MapFileError as error:
        raise MapFileError(f"{file}: {_foreign(file) or error}") from error
    except _DAMAGED as error:
        damaged = f"expected a whole {file.suffix} file, got a damaged one: {' '.join(str(error).split())[:150]}"
        raise MapFileError(f"{file}: {_foreign(file) or damaged}") from error
    if kept.all():
        return StoredMap(gaussians, "", harmonics)
    reason = f"expected {_FINITE}, got NaN or infinity"
    return StoredMap(gaussians.take(kept), "", harmonics[kept], int(np.count_nonzero(~kept)), reason)


def _foreign(file: Path) -> str:
    """Return that a file has another format than its suffix says; empty if that is not known."""
    found, suffix = foreign_file(file), file.suffix.lower()
    return "" if found in ("", _OWN_FORMATS.get(suffix)) else f"expected a {suffix} file, got {found}"
