"""Maps as standard 3DGS PLY files, binary little-endian, with our three columns beside the usual ones.

Columns: x y z | f_dc_0..2 = (rgb - 0.5) / C0 | opacity as logit | scale_0..2 as log | rot_0..3 = w x y z | and ours:
active, kappa, target. All are float, ours too, because common readers take a row for a run of floats; so kappa is exact
up to 2^24. Reading goes by name: any order and type; other tools' columns (normals, f_rest) are passed over, ours may
be missing (inactive, kappa 0, no target).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.typing import DTypeLike, NDArray

from gausslite.codec.files import write_atomic
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite.errors import InvalidInputError, MapFileError

SH_C0 = 0.28209479177387814
_MAX_GAUSSIANS = 100_000_000
_MAX_HEADER_BYTES = 1 << 16
# raw values that a float32 sigmoid and exponential can still tell apart from their limits
_OPACITY_EDGE = 1e-6
_POSITIONS, _COLOURS = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES, _ROTATIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_STANDARD = (*_POSITIONS, *_COLOURS, "opacity", *_SCALES, *_ROTATIONS)
_EXTRAS = ("active", "kappa", "target")
_ROW = np.dtype([(name, "<f4") for name in (*_STANDARD, *_EXTRAS)])
_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2"},
    **{"ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write the map, whole or not at all. Raises StorageError when the folder is not writable or the disk is full."""
    write_atomic(path, ply_bytes(gaussians))


def read_ply(path: Path) -> Gaussians:
    """Read a map. Raises MapFileError naming the file and what is wrong with it."""
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MapFileError(f"{path}: cannot read the map: {error.strerror or error}") from error
    try:
        return gaussians_from_ply(data)
    except MapFileError as error:
        raise MapFileError(f"{path}: {error}") from error


def ply_bytes(gaussians: Gaussians) -> bytes:
    """The whole file in memory."""
    rows = np.zeros(len(gaussians), _ROW)
    opacity = np.clip(gaussians.opacities.astype(np.float64), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    _fill(rows, _POSITIONS, gaussians.means_m)
    _fill(rows, _COLOURS, ((gaussians.rgb - 0.5) / SH_C0).astype(np.float32))
    _fill(rows, _SCALES, np.log(np.maximum(gaussians.scales_m, np.finfo(np.float32).tiny)))
    _fill(rows, _ROTATIONS, gaussians.quats_wxyz)
    rows["opacity"] = np.log(opacity / (1 - opacity))
    for name in _EXTRAS:
        rows[name] = getattr(gaussians, name)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    header += [f"property float {name}" for name in (*_STANDARD, *_EXTRAS)]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes()


def gaussians_from_ply(data: bytes) -> Gaussians:
    """The map in the bytes of a PLY file. Raises MapFileError."""
    count, row, start = _read_header(data)
    missing = [name for name in _STANDARD if name not in (row.names or ())]
    if missing:
        raise MapFileError(f"expected the columns of a 3DGS map, missing {', '.join(missing)}")
    if len(data) - start < count * row.itemsize:
        raise MapFileError(f"expected {count} Gaussians of {row.itemsize} bytes, got {len(data) - start} bytes of them")
    rows = np.frombuffer(data, row, count, start)
    present = [name for name in (*_STANDARD, *_EXTRAS) if name in (row.names or ())]
    bad = [name for name in present if not np.isfinite(rows[name].astype(np.float64)).all()]
    if bad:
        raise MapFileError(f"column {bad[0]}: expected finite values, got NaN or infinity")
    try:
        with np.errstate(over="raise"):
            return _to_gaussians({name: rows[name] for name in present}, count)
    except (InvalidInputError, FloatingPointError) as error:
        raise MapFileError(str(error)) from error


def _to_gaussians(raw: dict[str, NDArray[Any]], count: int) -> Gaussians:
    logits = np.clip(raw["opacity"].astype(np.float64), -60, 60)
    return Gaussians(
        _stack(raw, _POSITIONS),
        _stack(raw, _ROTATIONS),
        np.exp(_stack(raw, _SCALES)),
        (1 / (1 + np.exp(-logits))).astype(np.float32),
        _stack(raw, _COLOURS) * np.float32(SH_C0) + np.float32(0.5),
        raw.get("active", np.zeros(count)) != 0,
        _whole(raw.get("kappa", np.zeros(count)), np.uint32),
        _whole(raw.get("target", np.full(count, NO_TARGET)), np.int16),
    )


def _read_header(data: bytes) -> tuple[int, np.dtype[np.void], int]:
    """How many rows there are, what a row is, and where the first one starts."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise MapFileError("expected a PLY file, got something else")
    start = data.find(b"\n", end, end + 12) + 1
    if start == 0:
        raise MapFileError("the header has no end")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    kind = " ".join(lines[0]) if lines else "nothing"
    if kind != "format binary_little_endian 1.0":
        raise MapFileError(f"expected format binary_little_endian 1.0, got {kind}")
    if len(lines) < 2 or lines[1][:2] != ["element", "vertex"] or len(lines[1]) != 3:
        raise MapFileError("expected 'element vertex COUNT' as the first element")
    count = _count(lines[1][2])
    fields: dict[str, str] = {}
    for line in lines[2:]:
        # rows of later elements lie behind the vertices and are none of ours
        if line[0] == "element":
            break
        if len(line) != 3 or line[0] != "property" or line[1] not in _PLY_TYPES or line[2] in fields:
            raise MapFileError(f"expected 'property TYPE NAME' once per column, got {' '.join(line)!r}")
        fields[line[2]] = _PLY_TYPES[line[1]]
    return count, np.dtype(list(fields.items())), start


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 12 or int(text) > _MAX_GAUSSIANS:
        raise MapFileError(f"expected 0 to {_MAX_GAUSSIANS} Gaussians, got {text!r}")
    return int(text)


def _whole(values: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """To whole numbers, kept within the type's range: a float close to its end must not wrap round."""
    ends = np.iinfo(np.dtype(dtype))
    return np.clip(values.astype(np.float64), ends.min, ends.max).astype(dtype)


def _fill(rows: NDArray[Any], names: tuple[str, ...], values: NDArray[Any]) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _stack(raw: dict[str, NDArray[Any]], names: tuple[str, ...]) -> Float32[ndarray, "n k"]:
    return np.stack([raw[name].astype(np.float32) for name in names], axis=1)
