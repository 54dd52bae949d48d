"""Read a splat map of any trainer with its colours that depend on the view: PLY, .splat or SPZ."""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.codec.ply import SH_C0, left_out_note, read_stored_map
from gausslite.domain.errors import MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite.mission.results import map_file
from gausslite.process import import_extra
from gausslite_render.harmonics import COUNTS, rotated

MAX_GAUSSIANS: Final = 20_000_000
"""Of a file that is unpacked: 5 GB with harmonics of degree 3."""
_SPLAT_ROW = np.dtype([("mean_m", "<f4", 3), ("scale_m", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])
_TURN_ABOUT_X = np.array([1, -1, -1], np.float32)
"""Signs of x, y, z: SPZ's axes are right, up, back, those of PLY files right, down, forward."""
_SPZ_MAGIC, _SPZ_HEADER = 0x5053474E, struct.Struct("<IIIB")
_SPZ_MAX_BYTES, _SPZ_EXTENSION_BYTES = 65, 1 << 16
"""Of an unpacked Gaussian with harmonics of degree 3, and of what may follow them."""


@dataclass(frozen=True, slots=True, eq=False)
class SplatMap:
    """Gaussians with coefficients of spherical harmonics above degree 0; k is 0, 3, 8 or 15. note: what is left out."""

    gaussians: Gaussians
    harmonics: Float32[ndarray, "n 3 k"]
    note: str = ""

    @property
    def degree(self) -> int:
        """The degree of the harmonics."""
        return COUNTS.index(self.harmonics.shape[2])


def read_splats(path: Path) -> SplatMap:
    """Read a splat file by its suffix, or the map of a results folder.

    Raises MapFileError naming the file and the cause, InvalidInputError without the package that SPZ needs.
    """
    file = map_file(path)
    readers = {".splat": _read_splat, ".spz": _read_spz}
    try:
        found = readers.get(file.suffix.lower(), _read_ply)(file)
    except OSError as error:
        raise MapFileError(f"{file}: cannot read the map: {error.strerror or error}") from error
    if not len(found.gaussians):
        raise MapFileError(f"{file}: expected a map with at least one Gaussian, got none")
    return found


def _read_ply(path: Path) -> SplatMap:
    stored = read_stored_map(path)
    return SplatMap(stored.gaussians, stored.harmonics, left_out_note(stored) if stored.left_out else "")


def _read_splat(path: Path) -> SplatMap:
    """Read a .splat file: rows of 32 bytes, colours and rotations in 8 bits."""
    size, row = path.stat().st_size, _SPLAT_ROW.itemsize
    if size % row or size > MAX_GAUSSIANS * row:
        raise MapFileError(f"{path}: expected up to {MAX_GAUSSIANS} rows of {row} bytes, got {size} bytes")
    rows = np.frombuffer(path.read_bytes(), _SPLAT_ROW)
    rgba, quats = rows["rgba"].astype(np.float32) / 255, rows["quat_wxyz"].astype(np.float32) / 128 - 1
    gaussians = _gaussians(rows["mean_m"], quats, rows["scale_m"], rgba[:, 3], rgba[:, :3])
    return _of_finite(path, gaussians, np.zeros((len(rows), 3, 0), np.float32))


def _read_spz(path: Path) -> SplatMap:
    """Read an SPZ file, after its count has been compared with what it unpacks to."""
    gsply = import_extra("gsply", "export", "SPZ files")
    _require_spz_size(path)
    try:
        found = gsply.read_spz(str(path))
    except (ValueError, IndexError, RuntimeError, MemoryError) as error:
        raise MapFileError(f"{path}: expected an SPZ file; {' '.join(str(error).split())[:150]}") from error
    rest = np.zeros((len(found.means), 0, 3), np.float32) if found.shN is None else found.shN
    opacities = (1 / (1 + np.exp(-np.clip(found.opacities.reshape(-1), -60, 60)))).astype(np.float32)
    gaussians = _gaussians(
        found.means * _TURN_ABOUT_X,
        found.quats * np.concatenate([[np.float32(1)], _TURN_ABOUT_X]),
        np.exp(found.scales),
        opacities,
        found.sh0 * np.float32(SH_C0) + np.float32(0.5),
    )
    return _of_finite(path, gaussians, rotated(rest.transpose(0, 2, 1), np.diag(_TURN_ABOUT_X).astype(np.float64)))


def _require_spz_size(path: Path) -> None:
    """Raise MapFileError for a file that states too many Gaussians, or unpacks to more than it states."""
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    try:
        with gzip.open(path) if packed else path.open("rb") as file:
            magic, _, count, _ = _SPZ_HEADER.unpack(file.read(_SPZ_HEADER.size))
            if magic != _SPZ_MAGIC or count > MAX_GAUSSIANS:
                got = count if magic == _SPZ_MAGIC else "another file"
                raise MapFileError(f"{path}: expected an SPZ file of at most {MAX_GAUSSIANS} Gaussians, got {got}")
            limit = count * _SPZ_MAX_BYTES + _SPZ_EXTENSION_BYTES
            while packed and (part := file.read(1 << 20)):
                limit -= len(part)
                if limit < 0:
                    raise MapFileError(f"{path}: expected the bytes of {count} Gaussians, got more")
    except (gzip.BadGzipFile, EOFError, struct.error) as error:
        raise MapFileError(f"{path}: expected an SPZ file, got a damaged one: {error}") from error


def _gaussians(
    means_m: Float32[ndarray, "n 3"],
    quats_wxyz: Float32[ndarray, "n 4"],
    scales_m: Float32[ndarray, "n 3"],
    opacities: Float32[ndarray, " n"],
    rgb: Float32[ndarray, "n 3"],
) -> Gaussians:
    n, positive_m = len(means_m), np.maximum(scales_m, np.finfo(np.float32).tiny)
    return Gaussians(
        means_m=np.ascontiguousarray(means_m, np.float32),
        quats_wxyz=np.ascontiguousarray(quats_wxyz, np.float32),
        scales_m=np.ascontiguousarray(positive_m, np.float32),
        opacities=np.ascontiguousarray(opacities, np.float32),
        rgb=np.ascontiguousarray(rgb, np.float32),
        active=np.zeros(n, np.bool_),
        kappa=np.zeros(n, np.uint32),
        target=np.full(n, NO_TARGET, np.int16),
    )


def _of_finite(path: Path, gaussians: Gaussians, harmonics: Float32[ndarray, "n 3 k"]) -> SplatMap:
    """Return the map without rows of NaN or infinity, with a note. Raises MapFileError if none is left."""
    values = np.concatenate([gaussians.means_m, gaussians.scales_m, gaussians.quats_wxyz], axis=1)
    kept: Bool[ndarray, " n"] = np.isfinite(values).all(axis=1)
    if kept.all():
        return SplatMap(gaussians, harmonics)
    reason = f"left out {np.count_nonzero(~kept)} of {len(kept)} Gaussians: expected finite values, got NaN or infinity"
    if not kept.any():
        raise MapFileError(f"{path}: {reason}")
    return SplatMap(gaussians.take(kept), harmonics[kept], reason)
